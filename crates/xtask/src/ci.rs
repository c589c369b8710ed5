//! `cargo xtask ci`: everything that is checked without running the code.

use std::path::Path;

use anyhow::Result;

use crate::deploy::kubernetes;
use crate::deps;
use crate::python;
use crate::stage::{answers, cargo, run, stage};

/// Runs every check in the order of how fast it fails.
pub(crate) fn ci(root: &Path) -> Result<()> {
    stage("format", || {
        run(&mut cargo(root, ["fmt", "--all", "--check"]))
    })?;
    stage("dependency rules", || deps::check(root))?;
    python::check(root)?;
    // The commands in the manifests are checked by the tests, which have the binary.
    stage("Kubernetes manifests", || kubernetes::check(root, None))?;
    // Compiling cargo-deny takes longer than everything here together; our own rules run in any case.
    if answers(&mut cargo(root, ["deny", "--version"])) {
        stage("cargo deny", || {
            run(&mut cargo(
                root,
                ["deny", "--locked", "check", "bans", "licenses", "sources"],
            ))
        })?;
    } else {
        eprintln!("xtask: cargo deny: skipped, cargo-deny is not installed");
    }
    let clippy = |which: &[&str]| {
        let mut command = cargo(root, ["clippy", "--all-targets", "--locked"]);
        run(command.args(which).args(["--", "-D", "warnings"]))
    };
    stage("clippy", || clippy(&["--workspace"]))?;
    // Elsewhere than on Linux there is no MuJoCo.
    stage("clippy without MuJoCo", || {
        clippy(&["--package", "isodream-envs", "--no-default-features"])
    })?;
    // What the image of the replay-server holds.
    stage("clippy without libtorch", || {
        clippy(&["--package", "isodream", "--no-default-features"])
    })?;
    stage("doc", || {
        let args = ["doc", "--workspace", "--no-deps", "--locked"];
        run(cargo(root, args).env("RUSTDOCFLAGS", "-D warnings"))
    })
}
