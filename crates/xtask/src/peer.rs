//! `cargo xtask bench peer`: our training step and the same step in plain PyTorch, one right after the other.

use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result};
use serde_json::Value;

use crate::run::release_binary;
use crate::stage::{output, run, stage, with_native};
use crate::venv::Venv;

/// The PyTorch that shares our libtorch's version, with everything it needs.
const TORCH: &str = "torch==2.11.0";

/// What both sides are asked to do.
#[derive(Debug, clap::Args)]
pub(crate) struct PeerArgs {
    /// Sequences per batch
    #[arg(long, default_value_t = 16)]
    batch: u32,
    /// Steps per sequence
    #[arg(long, default_value_t = 32)]
    length: u32,
    /// Steps that are measured; the fastest counts
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// Let the peer also do the work of the published code that nobody uses
    #[arg(long)]
    as_published: bool,
}

/// Measures both and prints them with their ratios.
pub(crate) fn peer(root: &Path, args: &PeerArgs) -> Result<()> {
    let binary = release_binary(root)?;
    let python = python(root)?;
    let options: Vec<String> = [
        ("--batch", args.batch),
        ("--length", args.length),
        ("--steps", args.steps),
    ]
    .iter()
    .flat_map(|(name, value)| [(*name).to_owned(), value.to_string()])
    .collect();

    // The peer predicts actions from embeddings, as the published code does.
    let mut ours = Command::new(binary);
    ours.args(["bench", "learner", "--preset", "paper", "--json"])
        .args(["--set", "model.inverse=embed_diff"])
        .args(&options);
    with_native(&mut ours, root);
    let mut theirs = Command::new(python);
    theirs.arg(root.join("bench/peer.py")).args(&options);
    theirs.args(args.as_published.then_some("--as-published"));
    // Both with waiting threads that soon sleep: CPU seconds would count their spinning.
    theirs.envs([("OMP_WAIT_POLICY", "PASSIVE"), ("GOMP_SPINCOUNT", "1000")]);
    let ours = stage("isodream", || measured(&mut ours))?;
    let theirs = stage("plain PyTorch", || measured(&mut theirs))?;

    eprintln!(
        "{:<24} {:>10} {:>14} {:>7}",
        "per training step", "isodream", "plain PyTorch", "ratio"
    );
    for (name, key, unit) in [
        ("wall seconds", "wall_seconds_per_step", 1.0),
        ("CPU seconds", "cpu_seconds_per_step", 1.0),
        ("peak memory, GB", "peak_rss_bytes", 1e9),
    ] {
        let value = |side: &Value| -> Result<f64> {
            let number = side[key].as_f64();
            Ok(number.with_context(|| format!("no `{key}` in the result"))? / unit)
        };
        let (a, b) = (value(&ours)?, value(&theirs)?);
        eprintln!("{name:<24} {a:>10.3} {b:>14.3} {:>7.3}", a / b);
    }
    Ok(())
}

fn measured(command: &mut Command) -> Result<Value> {
    Ok(serde_json::from_slice(&output(command)?)?)
}

/// Python with PyTorch, in a virtual environment of its own.
fn python(root: &Path) -> Result<std::path::PathBuf> {
    let title = "install PyTorch (several GB, once)";
    let venv = Venv::ensure(root, "peer", TORCH, title, |venv| {
        run(venv.pip().arg(TORCH))
    })?;
    Ok(venv.program("python"))
}
