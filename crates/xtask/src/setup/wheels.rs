//! libtorch out of the wheels of PyTorch, by pip: the one source that every mirror and proxy carries.
//!
//! The Linux wheels are CUDA builds. Their CPU library runs alone but links two small CUDA libraries,
//! which come from wheels of their own; nothing else of CUDA is kept.

use std::env::consts::{ARCH, OS};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail};

use super::manifest::Manifest;
use super::{VERSION, linked, preflight};
use crate::stage::{run, stage};

/// Copies what we keep out of the wheels.
const UNPACK: &str = include_str!("unpack.py");

/// The wheels are pinned for one Python, so that their hashes are too; any Python can fetch and unpack them.
const PYTHON_VERSION: &str = "3.12";
const PYTHON_ABI: &str = "cp312";

/// What one kind of machine needs.
struct Platform {
    os: &'static str,
    arch: &'static str,
    /// Names that pip has for it.
    tags: &'static [&'static str],
    /// Requirement and SHA-256 of each wheel.
    wheels: &'static [(&'static str, &'static str)],
    libraries: &'static [&'static str],
}

const PLATFORMS: &[Platform] = &[
    Platform {
        os: "linux",
        arch: "x86_64",
        tags: &[
            "manylinux_2_28_x86_64",
            "manylinux_2_25_x86_64",
            "manylinux2014_x86_64",
        ],
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
        tags: &[
            "manylinux_2_28_aarch64",
            "manylinux_2_25_aarch64",
            "manylinux2014_aarch64",
        ],
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
        tags: &["macosx_11_0_arm64"],
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

/// Whether `libtorch` holds everything that [`make`] puts there.
pub(super) fn is_complete(libtorch: &Path) -> bool {
    let present = |name: &&str| {
        fs::metadata(libtorch.join("lib").join(name)).is_ok_and(|metadata| metadata.len() > 0)
    };
    let version = fs::read_to_string(libtorch.join("build-version")).unwrap_or_default();
    platform().is_ok_and(|platform| platform.libraries.iter().all(present))
        && linked::missing(libtorch).is_none()
        && version.trim() == build_version()
}

/// Fetches the wheels into `work` and unpacks what we need of them to `made`.
pub(super) fn make(work: &Path, made: &Path) -> Result<Manifest> {
    let platform = platform()?;
    preflight::python()?;
    preflight::disk(work)?;
    let wheels = stage("fetch libtorch", || fetch(platform, work))?;
    stage("unpack libtorch", || {
        let mut command = Command::new("python3");
        command
            .args(["-c", UNPACK])
            .arg(made)
            .arg(platform.libraries.join(","))
            .args(&wheels);
        run(&mut command)?;
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

/// Has pip fetch and check the wheels of `platform`, and returns them.
fn fetch(platform: &Platform, work: &Path) -> Result<Vec<PathBuf>> {
    let requirements = work.join("requirements.txt");
    let lines = platform
        .wheels
        .iter()
        .map(|(requirement, sha256)| format!("{requirement} --hash=sha256:{sha256}\n"));
    fs::write(&requirements, lines.collect::<String>())?;
    let folder = work.join("wheels");
    let mut command = Command::new("python3");
    command
        .args([
            "-m",
            "pip",
            "download",
            "--disable-pip-version-check",
            "--no-cache-dir",
        ])
        .args(["--no-deps", "--only-binary=:all:", "--require-hashes"])
        .args(["--implementation", "cp", "--python-version", PYTHON_VERSION])
        .args(["--abi", PYTHON_ABI, "--abi", "none"]);
    for tag in platform.tags {
        command.args(["--platform", tag]);
    }
    command
        .arg("--requirement")
        .arg(&requirements)
        .arg("--dest")
        .arg(&folder);
    run(&mut command).with_context(|| {
        format!(
            "pip could not fetch libtorch, its own words are above: check the network, the proxy (HTTPS_PROXY) and \
             pip's index, or set LIBTORCH to an unpacked libtorch {VERSION}"
        )
    })?;
    let mut wheels = Vec::new();
    for entry in fs::read_dir(&folder)? {
        wheels.push(entry?.path());
    }
    wheels.sort();
    Ok(wheels)
}

fn build_version() -> String {
    format!("{VERSION}+cpu")
}
