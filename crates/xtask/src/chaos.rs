//! `cargo xtask chaos`: faults injected into trainings that run for real.

use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result};

use crate::run::{release_binary, target_dir};
use crate::stage::{cargo, run, stage, with_native};

/// Builds what is needed in release mode and becomes `chaos`, so that Ctrl-C reaches it, and it can clean up.
pub(crate) fn chaos(root: &Path, args: &[String]) -> Result<()> {
    let runs = args.first().is_some_and(|word| word == "run");
    let has_binary = args.iter().any(|word| word.starts_with("--binary"));
    let binary = if runs && !has_binary {
        Some(release_binary(root)?)
    } else {
        None
    };
    stage("build chaos", || {
        let args = ["build", "--release", "--locked", "-p", "isodream-chaos"];
        run(&mut cargo(root, args))
    })?;
    let program = target_dir(root)?.join("release/chaos");
    let mut command = Command::new(&program);
    command.args(args);
    if let Some(binary) = binary {
        command.arg("--binary").arg(binary);
    }
    with_native(&mut command, root);
    let error = command.exec();
    Err(error).with_context(|| format!("cannot start {}", program.display()))
}
