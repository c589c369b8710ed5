//! `.native/mujoco/{lib,suite}`: MuJoCo's library, and the models of the DeepMind Control Suite.

use std::env::consts::{ARCH, OS};
use std::os::unix::fs::symlink;
use std::path::Path;

use anyhow::{Context, Result};

use super::manifest::Manifest;
use super::wheels::{self, Keep, Wheel};
use super::{checked, install, preflight};
use crate::stage::stage;

/// What the folder and the work on it are called.
const NAME: &str = "mujoco";
const MANIFEST: &str = "mujoco.json";

/// What programs ask the loader for, and what the linker looks for.
const LIBRARY: &str = "libmujoco.so.3.17.0";
const LINK: &str = "libmujoco.so";

/// The wheel of each kind of Linux machine. None for macOS, where nobody has run it: switch off the feature
/// `mujoco` of isodream-envs there.
const LIBRARIES: &[(&str, Wheel)] = &[
    (
        "x86_64",
        (
            "mujoco==3.17.0",
            "42371356efe53a5f5f73ed03fcb967bdf04048017f80e2fca01e71a360e42da2",
        ),
    ),
    (
        "aarch64",
        (
            "mujoco==3.17.0",
            "525e09a00ecd964f06582773d9eeb03bb0e5a1675edf296a6868024759b3b235",
        ),
    ),
];
/// The models are the same everywhere.
const SUITE: Wheel = (
    "dm-control==1.0.50",
    "5434e1e51ff69016867426da7df6064b18d140e4d0a628f879bbcf0e7d0a586d",
);

/// Makes `.native/mujoco` complete; with `verify` every file is hashed, not only measured.
pub(super) fn ensure(native: &Path, verify: bool) -> Result<()> {
    let library = LIBRARIES
        .iter()
        .find(|(arch, _)| OS == "linux" && *arch == ARCH);
    let Some(&(_, library)) = library else {
        eprintln!(
            "xtask: no MuJoCo is known for {OS} on {ARCH}: without DeepMind Control, \
             switch off the feature `mujoco` of isodream-envs"
        );
        return Ok(());
    };
    let wheels = [library, SUITE];
    let reason = match Manifest::read(native, MANIFEST) {
        None => "it is not there".to_owned(),
        Some(manifest) if !manifest.is_of_wheels(wheels.map(|(_, sha256)| sha256)) => {
            "another version is asked for".to_owned()
        }
        Some(manifest) => {
            let mismatch = || manifest.mismatch(&native.join(NAME), verify);
            match checked(NAME, verify, mismatch)? {
                None => return Ok(()),
                Some(reason) => reason,
            }
        }
    };
    install(native, NAME, MANIFEST, &reason, |work, made| {
        preflight::python(NAME, "it has no other source")?;
        let wheels = stage("fetch MuJoCo", || {
            wheels::fetch(&wheels, work).context("pip could not fetch MuJoCo")
        })?;
        stage("unpack MuJoCo", || {
            let models = Keep {
                pattern: "dm_control/suite/*.xml".to_owned(),
                strip: Some("dm_control/suite/"),
                into: "suite",
            };
            wheels::unpack(&[Keep::library(LIBRARY), models], &wheels, made)?;
            let link = made.join("lib").join(LINK);
            symlink(LIBRARY, &link).with_context(|| format!("cannot link {}", link.display()))?;
            Manifest::of_files(made, &wheels)
        })
    })
}
