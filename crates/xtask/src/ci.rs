//! `cargo xtask ci`: everything that is checked without running the code.

use std::path::Path;

use anyhow::Result;

use crate::deps;
use crate::stage::{answers, cargo, run, stage};

/// Runs every check in the order of how fast it fails.
pub(crate) fn ci(root: &Path) -> Result<()> {
    stage("format", || {
        run(&mut cargo(root, ["fmt", "--all", "--check"]))
    })?;
    stage("dependency rules", || deps::check(root))?;
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
    stage("clippy", || {
        let args = [
            "clippy",
            "--workspace",
            "--all-targets",
            "--locked",
            "--",
            "-D",
            "warnings",
        ];
        run(&mut cargo(root, args))
    })?;
    stage("doc", || {
        let args = ["doc", "--workspace", "--no-deps", "--locked"];
        run(cargo(root, args).env("RUSTDOCFLAGS", "-D warnings"))
    })
}
