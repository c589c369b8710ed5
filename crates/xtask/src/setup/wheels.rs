//! Libraries and files out of Python wheels, by pip: the one source that every mirror and proxy carries.

use std::env::consts::{ARCH, OS};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};
use serde_json::json;

use crate::stage::run;

/// Copies what we keep out of the wheels.
const UNPACK: &str = include_str!("unpack.py");

/// The wheels are pinned for one Python, so that their hashes are too; any Python can fetch and unpack them.
const PYTHON_VERSION: &str = "3.12";
const PYTHON_ABI: &str = "cp312";

/// Requirement and SHA-256 of a wheel.
pub(super) type Wheel = (&'static str, &'static str);

/// Which members of the wheels are kept, and where.
pub(super) struct Keep {
    /// Shell pattern of whole member names; `*` crosses folders.
    pub(super) pattern: String,
    /// Taken off the front of the names, or everything up to the last `/` where absent.
    pub(super) strip: Option<&'static str>,
    /// Folder that they go to.
    pub(super) into: &'static str,
}

impl Keep {
    /// The library of this name, wherever it is, in `lib`.
    pub(super) fn library(name: &str) -> Self {
        Self {
            pattern: format!("*/{name}"),
            strip: None,
            into: "lib",
        }
    }
}

/// Names that pip has for this machine.
fn tags() -> &'static [&'static str] {
    match (OS, ARCH) {
        ("linux", "x86_64") => &[
            "manylinux_2_28_x86_64",
            "manylinux_2_25_x86_64",
            "manylinux2014_x86_64",
        ],
        ("linux", "aarch64") => &[
            "manylinux_2_28_aarch64",
            "manylinux_2_25_aarch64",
            "manylinux2014_aarch64",
        ],
        ("macos", "aarch64") => &["macosx_11_0_arm64"],
        _ => &[],
    }
}

/// Has pip fetch and check `wheels` into `work`, and returns the files.
pub(super) fn fetch(wheels: &[Wheel], work: &Path) -> Result<Vec<PathBuf>> {
    let requirements = work.join("requirements.txt");
    let lines = wheels
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
    for tag in tags() {
        command.args(["--platform", tag]);
    }
    command
        .arg("--requirement")
        .arg(&requirements)
        .arg("--dest")
        .arg(&folder);
    run(&mut command).context(
        "pip's own words are above: check the network, the proxy (HTTPS_PROXY) and pip's index",
    )?;
    let mut files = Vec::new();
    for entry in fs::read_dir(&folder)? {
        files.push(entry?.path());
    }
    files.sort();
    Ok(files)
}

/// Copies what `keep` names out of `wheels` to below `made`.
pub(super) fn unpack(keep: &[Keep], wheels: &[PathBuf], made: &Path) -> Result<()> {
    let rules: Vec<_> = keep
        .iter()
        .map(|keep| json!([keep.pattern, keep.strip, keep.into]))
        .collect();
    let mut command = Command::new("python3");
    command
        .args(["-c", UNPACK])
        .arg(made)
        .arg(json!(rules).to_string())
        .args(wheels);
    run(&mut command)
}
