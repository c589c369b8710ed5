//! `cargo xtask test` and `cargo xtask demo`: everything that runs the code.

use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};
use serde_json::Value;

use crate::deploy::kubernetes;
use crate::python;
use crate::stage::{answers, cargo, output, run, stage, with_native};

/// Runs all tests, or with `args` those that they select.
pub(crate) fn test(root: &Path, args: &[String]) -> Result<()> {
    // The process-level tests start the binaries, which nothing makes cargo build for them.
    stage("build binaries", || {
        run(&mut cargo(
            root,
            ["build", "--workspace", "--bins", "--locked"],
        ))
    })?;
    if args.is_empty() {
        let isodream = target_dir(root)?.join("debug/isodream");
        stage("commands of the Kubernetes manifests", || {
            kubernetes::check(root, Some(&isodream))
        })?;
        python::test(root, &isodream)?;
    }
    let runner: &[&str] = if answers(&mut cargo(root, ["nextest", "--version"])) {
        &["nextest", "run"]
    } else {
        // Not --all-targets: that would run benchmarks. Doc tests have their own stage.
        &["test", "--lib", "--bins", "--tests"]
    };
    stage("tests", || {
        let mut command = cargo(root, runner.iter().copied());
        run(command.args(["--workspace", "--locked"]).args(args))
    })?;
    if args.is_empty() && answers(Command::new("chromium").arg("--version")) {
        stage("the dashboard in Chromium", || {
            let page = ["--package", "isodream-dashboard", "--test", "page"];
            let mut command = cargo(root, ["test", "--locked", "--quiet"]);
            run(command.args(page).args(["--", "--ignored"]))
        })?;
    } else if args.is_empty() {
        eprintln!("xtask: the dashboard in Chromium: skipped, chromium is not installed");
    }
    if args.is_empty() {
        stage("doc tests", || {
            run(&mut cargo(
                root,
                ["test", "--doc", "--workspace", "--locked", "--quiet"],
            ))
        })?;
    }
    Ok(())
}

/// Feeds damaged bytes to the decoders, each for `seconds`, all at once.
pub(crate) fn fuzz(root: &Path, seconds: u64) -> Result<()> {
    let args = [
        "test",
        "--release",
        "--locked",
        "--package=isodream-replay-server",
        "--test=fuzz",
        "--",
        "--nocapture",
    ];
    stage("fuzz", || {
        run(cargo(root, args).env("ISODREAM_FUZZ_SECONDS", seconds.to_string()))
    })
}

/// Builds the release binary and says where it is.
pub(crate) fn release_binary(root: &Path) -> Result<PathBuf> {
    stage("build", || {
        run(&mut cargo(
            root,
            ["build", "--release", "--locked", "-p", "isodream"],
        ))
    })?;
    Ok(target_dir(root)?.join("release/isodream"))
}

/// Builds the release binary and becomes it, so that signals reach the run and not us.
pub(crate) fn demo(root: &Path, args: &[String]) -> Result<()> {
    let binary = release_binary(root)?;
    let mut command = Command::new(&binary);
    command
        .current_dir(root)
        .args(["train", "--preset", "quick", "--run-dir", "runs/demo"])
        .args(args);
    with_native(&mut command, root);
    let error = command.exec();
    Err(error).with_context(|| format!("cannot start {}", binary.display()))
}

/// Where cargo builds, wherever that was configured.
pub(crate) fn target_dir(root: &Path) -> Result<PathBuf> {
    let args = ["metadata", "--no-deps", "--format-version", "1", "--locked"];
    let metadata: Value = serde_json::from_slice(&output(&mut cargo(root, args))?)?;
    let target = metadata["target_directory"]
        .as_str()
        .context("cargo metadata names no target directory")?;
    Ok(target.into())
}
