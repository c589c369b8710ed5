//! `.native/libtorch/{include,lib,build-version}`: out of the wheels of PyTorch, or links to what the user has.
//!
//! The Linux wheels are CUDA builds. Their CPU library runs alone but links two small CUDA libraries,
//! which come from wheels of their own; nothing else of CUDA is kept.

use std::env::consts::{ARCH, OS};
use std::fs;
use std::path::Path;

use anyhow::{Context, Result, bail};

use super::manifest::Manifest;
use super::wheels::{self, Keep, Wheel};
use super::{checked, install, linked, preflight};
use crate::stage::stage;

/// The libtorch that tch builds against.
pub(super) const VERSION: &str = "2.11.0";
/// What the folder and the work on it are called.
const NAME: &str = "libtorch";
const MANIFEST: &str = "manifest.json";

/// What one kind of machine needs.
struct Platform {
    os: &'static str,
    arch: &'static str,
    wheels: &'static [Wheel],
    libraries: &'static [&'static str],
}

const PLATFORMS: &[Platform] = &[
    Platform {
        os: "linux",
        arch: "x86_64",
        wheels: &[
            (
                "torch==2.11.0",
                "0f68f4ac6d95d12e896c3b7a912b5871619542ec54d3649cf48cc1edd4dd2756",
            ),
            (
                "nvidia-cuda-runtime==13.0.96",
                "7f82250d7782aa23b6cfe765ecc7db554bd3c2870c43f3d1821f1d18aebf0548",
            ),
            (
                "nvidia-cuda-cupti==13.0.85",
                "4eb01c08e859bf924d222250d2e8f8b8ff6d3db4721288cf35d14252a4d933c8",
            ),
        ],
        libraries: &[
            "libc10.so",
            "libtorch_cpu.so",
            "libgomp.so.1",
            "libcudart.so.13",
            "libcupti.so.13",
        ],
    },
    Platform {
        os: "linux",
        arch: "aarch64",
        wheels: &[
            (
                "torch==2.11.0",
                "f99924682ef0aa6a4ab3b1b76f40dc6e273fca09f367d15a524266db100a723f",
            ),
            (
                "nvidia-cuda-runtime==13.0.96",
                "ef9bcbe90493a2b9d810e43d249adb3d02e98dd30200d86607d8d02687c43f55",
            ),
            (
                "nvidia-cuda-cupti==13.0.85",
                "796bd679890ee55fb14a94629b698b6db54bcfd833d391d5e94017dd9d7d3151",
            ),
        ],
        libraries: &[
            "libc10.so",
            "libtorch_cpu.so",
            "libgomp.so.1",
            "libarm_compute.so",
            "libarm_compute_graph.so",
            "libnvpl_blas_core.so.0",
            "libnvpl_blas_lp64_gomp.so.0",
            "libnvpl_lapack_core.so.0",
            "libnvpl_lapack_lp64_gomp.so.0",
            "libcudart.so.13",
            "libcupti.so.13",
        ],
    },
    Platform {
        os: "macos",
        arch: "aarch64",
        wheels: &[(
            "torch==2.11.0",
            "4b5866312ee6e52ea625cd211dcb97d6a2cdc1131a5f15cc0d87eec948f6dd34",
        )],
        libraries: &[
            "libc10.dylib",
            "libtorch_cpu.dylib",
            "libtorch.dylib",
            "libomp.dylib",
        ],
    },
];

fn platform() -> Result<&'static Platform> {
    PLATFORMS
        .iter()
        .find(|platform| platform.os == OS && platform.arch == ARCH)
        .with_context(|| {
            format!(
                "no libtorch is known for {OS} on {ARCH}: set LIBTORCH to one of version {VERSION}"
            )
        })
}

/// Makes `.native/libtorch` complete; with `verify` every file is hashed, not only measured.
pub(super) fn ensure(root: &Path, native: &Path, verify: bool) -> Result<()> {
    let libtorch = native.join(NAME);
    let wanted = linked::wanted(root)?;
    let mismatch = |manifest: &Manifest| match linked::missing(&libtorch) {
        Some(missing) => Some(format!("{missing} is missing")),
        None => manifest.mismatch(&libtorch, verify),
    };
    let reason = match Manifest::read(native, MANIFEST) {
        Some(manifest)
            if wanted.is_some()
                && manifest.linked() != wanted.as_ref().map(|w| w.path.as_path()) =>
        {
            "another libtorch is asked for by the environment".to_owned()
        }
        Some(manifest) => match checked(NAME, verify, || mismatch(&manifest))? {
            None => return Ok(()),
            Some(reason) => reason,
        },
        None if wanted.is_none() && is_complete(&libtorch) => {
            preflight::compiler()?;
            return stage("adopt the libtorch that is there", || {
                Manifest::of_files(&libtorch, &[])?.write(native, MANIFEST)
            });
        }
        None => "it is not complete".to_owned(),
    };
    install(native, NAME, MANIFEST, &reason, |work, made| {
        preflight::compiler()?;
        match &wanted {
            Some(present) => linked::make(present, made),
            None => make(work, made),
        }
    })
}

/// Whether `libtorch` holds everything that [`make`] puts there.
fn is_complete(libtorch: &Path) -> bool {
    let present = |name: &&str| {
        fs::metadata(libtorch.join("lib").join(name)).is_ok_and(|metadata| metadata.len() > 0)
    };
    let version = fs::read_to_string(libtorch.join("build-version")).unwrap_or_default();
    platform().is_ok_and(|platform| platform.libraries.iter().all(present))
        && linked::missing(libtorch).is_none()
        && version.trim() == build_version()
}

/// Fetches the wheels into `work` and unpacks what we need of them to `made`.
fn make(work: &Path, made: &Path) -> Result<Manifest> {
    let platform = platform()?;
    let cure = format!("or set LIBTORCH to an unpacked libtorch {VERSION}");
    preflight::python(NAME, &cure)?;
    preflight::disk(work)?;
    let wheels = stage("fetch libtorch", || {
        wheels::fetch(platform.wheels, work)
            .with_context(|| format!("pip could not fetch libtorch, help it {cure}"))
    })?;
    stage("unpack libtorch", || {
        let headers = Keep {
            pattern: "torch/include/*".to_owned(),
            strip: Some("torch/"),
            into: "",
        };
        let mut keep = vec![headers];
        keep.extend(platform.libraries.iter().map(|name| Keep::library(name)));
        wheels::unpack(&keep, &wheels, made)?;
        if platform.os == "linux" {
            // The real one would pull in all of CUDA.
            fs::write(made.join("lib/libtorch.so"), "INPUT(libtorch_cpu.so)\n")?;
        }
        fs::write(made.join("build-version"), format!("{}\n", build_version()))?;
        if !is_complete(made) {
            bail!(
                "the wheels hold not all of the libraries that are needed: was the pin of torch changed?"
            );
        }
        Manifest::of_files(made, &wheels)
    })
}

fn build_version() -> String {
    format!("{VERSION}+cpu")
}
