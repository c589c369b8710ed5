//! What one types in this repository: `cargo xtask setup | ci | test | fuzz | chaos | demo | bench | image | deploy`.
//!
//! Needs neither native libraries nor network to build, because it is what fetches the libraries.

mod chaos;
mod ci;
mod deploy;
mod deps;
mod docker;
mod image;
mod peer;
mod python;
mod run;
mod setup;
mod stage;
mod venv;

use std::process::ExitCode;

use anyhow::Result;
use clap::{Parser, Subcommand};

/// Bootstrap of native libraries, checks, tests and the demo.
#[derive(Debug, Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask")]
struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Put libtorch and MuJoCo into .native/; does nothing where they already stand.
    Setup {
        /// Hash every file instead of comparing sizes.
        #[arg(long)]
        verify: bool,
    },
    /// Formatting, lints, docs and dependency rules, in Rust and Python.
    Ci,
    /// All tests; with arguments only the tests they select.
    Test {
        /// Passed on to cargo nextest run, or cargo test where nextest is not installed.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<String>,
    },
    /// Feed damaged bytes to every decoder for a while.
    Fuzz {
        /// Seconds per decoder.
        #[arg(long, default_value_t = 60)]
        seconds: u64,
    },
    /// Inject faults into trainings that run for real: `chaos list`, `chaos run [NAME..]`.
    Chaos {
        /// Passed on to chaos.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<String>,
    },
    /// Build in release mode and train the quick preset in runs/demo.
    Demo {
        /// Passed on to isodream train.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<String>,
    },
    /// Measure this project beside others.
    #[command(subcommand)]
    Bench(Bench),
    /// Build the container images of the roles.
    Image(image::ImageArgs),
    /// Run what lies in deploy/ for real.
    #[command(subcommand)]
    Deploy(deploy::Deploy),
}

#[derive(Debug, Subcommand)]
enum Bench {
    /// A training step beside the same step in plain PyTorch, which is installed for it.
    Peer(peer::PeerArgs),
}

fn main() -> ExitCode {
    match run_command(Args::parse().command) {
        Ok(()) => ExitCode::SUCCESS,
        // By hand, because `main` would add a backtrace where RUST_BACKTRACE is set.
        Err(error) => {
            eprintln!("xtask: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run_command(command: Command) -> Result<()> {
    let root = stage::repository_root()?;
    let verify = matches!(command, Command::Setup { verify: true });
    setup::ensure(&root, verify)?;
    match command {
        Command::Setup { .. } => Ok(()),
        Command::Ci => ci::ci(&root),
        Command::Test { args } => run::test(&root, &args),
        Command::Fuzz { seconds } => run::fuzz(&root, seconds),
        Command::Chaos { args } => chaos::chaos(&root, &args),
        Command::Demo { args } => run::demo(&root, &args),
        Command::Bench(Bench::Peer(args)) => peer::peer(&root, &args),
        Command::Image(args) => image::image(&root, &args),
        Command::Deploy(engine) => deploy::deploy(&root, engine),
    }
}
