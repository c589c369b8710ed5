//! `cargo xtask deploy slurm`: `deploy/slurm/isodream.sbatch` run for real, on a Slurm of this machine's own.
//!
//! Two nodes train the debug preset, a third takes over from one that fails. What is durable is looked at twice a
//! second, and may never get less.

mod cluster;
mod drill;
mod progress;
mod run;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};
use clap::Args;

use self::drill::{Drill, Subject};
use crate::run::release_binary;
use crate::stage::{run, stage};

/// Options of `cargo xtask deploy slurm`.
#[derive(Debug, Args)]
pub(crate) struct SlurmArgs {
    /// The binary to run; the release binary is built by default
    #[arg(long)]
    binary: Option<PathBuf>,
    /// Environment frames of the run: more on a faster machine, where it must outlast everything that is done to it
    #[arg(long, default_value_t = 60_000)]
    env_frames: u64,
    /// Neither tokens nor TLS
    #[arg(long)]
    insecure: bool,
    /// Leave the folder with all logs
    #[arg(long)]
    keep: bool,
}

/// Runs the batch script through everything that it must survive, and prints what was done.
pub(crate) fn slurm(root: &Path, args: &SlurmArgs) -> Result<()> {
    cluster::require()?;
    let script = root.join("deploy/slurm/isodream.sbatch");
    stage(
        "shellcheck",
        || run(Command::new("shellcheck").arg(&script)),
    )?;
    let binary = match &args.binary {
        Some(binary) => fs::canonicalize(binary)
            .with_context(|| format!("no binary at {}", binary.display()))?,
        None => release_binary(root)?,
    };
    let dir = std::env::temp_dir().join(format!("isodream-slurm-{}", std::process::id()));
    fs::create_dir(&dir).with_context(|| format!("cannot make {}", dir.display()))?;
    let subject = Subject {
        root: root.to_owned(),
        binary,
        script,
        insecure: args.insecure,
        env_frames: args.env_frames,
    };
    let result = Drill::new(subject, &dir).and_then(|mut drill| {
        let result = drill.all();
        drill.print();
        result
    });
    if args.keep {
        eprintln!("xtask: everything is in {}", dir.display());
        return result;
    }
    if result.is_err() {
        show_job_logs(&dir)?;
    }
    fs::remove_dir_all(&dir).with_context(|| format!("cannot remove {}", dir.display()))?;
    result
}

/// Prints what the jobs have to say, before it is removed.
fn show_job_logs(dir: &Path) -> Result<()> {
    let paths = fs::read_dir(dir)?.flatten().map(|entry| entry.path());
    for path in paths.filter(|path| path.extension() == Some("out".as_ref())) {
        eprintln!("{}:\n{}", path.display(), fs::read_to_string(&path)?);
    }
    Ok(())
}
