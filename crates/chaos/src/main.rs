//! `cargo xtask chaos`: injects faults into trainings that run for real, and measures what they cost.
//!
//! Every scenario starts a training of its own: replay-servers, a learner, actors and an evaluator as processes of the
//! `isodream` binary, each under a supervisor that starts it again. Beside them run ledger actors, which write down
//! every chunk that a replay-server acknowledged to them. In the end all servers stop, and what the stores hold is
//! compared with the ledgers.

mod cluster;
mod faketime;
mod interrupt;
mod ledger;
mod ledger_actor;
mod netns;
mod plan;
mod probe;
mod role;
mod scenarios;
mod secrets;
mod settings;
mod table;
mod watch;

use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use clap::{Args, Parser, Subcommand};

use scenarios::{Context, Scenario};
use table::Row;

#[derive(Debug, Parser)]
#[command(
    name = "chaos",
    bin_name = "cargo xtask chaos",
    about = "Faults injected for real"
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Name all scenarios.
    List,
    /// Run scenarios, all of them by default.
    Run(RunArgs),
    /// An actor without an environment that writes down what it was promised.
    #[command(hide = true)]
    LedgerActor(ledger_actor::LedgerActorArgs),
}

#[derive(Debug, Args)]
struct RunArgs {
    /// The scenarios, as `list` names them
    names: Vec<String>,
    /// Length of the soak
    #[arg(long, default_value_t = 30.0)]
    minutes: f64,
    /// Kills of each kind of role
    #[arg(long, default_value_t = 5)]
    kills: usize,
    /// Seconds that partitions, stopped processes and the like last
    #[arg(long, default_value_t = 60)]
    hold_secs: u64,
    /// What the order of kills is drawn from
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// The `isodream` binary
    #[arg(long, default_value = "target/release/isodream")]
    binary: PathBuf,
    /// Where the results go as JSON
    #[arg(long)]
    out: Option<PathBuf>,
}

fn main() -> ExitCode {
    let ended = match Cli::parse().command {
        Command::List => {
            for scenario in scenarios::ALL {
                print(&format!("{:12} {}", scenario.name, scenario.about));
            }
            Ok(true)
        }
        Command::Run(args) => run(&args),
        Command::LedgerActor(args) => tokio::runtime::Runtime::new()
            .map_err(Into::into)
            .and_then(|runtime| runtime.block_on(ledger_actor::run(args)))
            .map(|()| true),
    };
    match ended {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("chaos: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// A reader that has read enough may have closed standard output.
fn print(text: &str) {
    let _ = writeln!(std::io::stdout(), "{text}");
}

/// Whether every fault was survived as it should be.
fn run(args: &RunArgs) -> Result<bool> {
    let chosen = scenarios::choose(&args.names)?;
    let context = Context {
        binary: args
            .binary
            .canonicalize()
            .with_context(|| format!("cannot find {}", args.binary.display()))?,
        kills: args.kills,
        soak: Duration::try_from_secs_f64(60.0 * args.minutes).context("--minutes is no length")?,
        hold: Duration::from_secs(args.hold_secs),
        seed: args.seed,
    };
    let runtime = tokio::runtime::Runtime::new()?;
    let shutdown = {
        let _inside = runtime.enter();
        isodream_rpc::shutdown_on_signal()?
    };
    runtime.spawn(async move {
        shutdown.cancelled().await;
        interrupt::interrupt();
    });
    let mut rows = Vec::new();
    for scenario in chosen {
        rows.extend(run_one(scenario, &context));
    }
    print(&table::render(&rows));
    if let Some(out) = &args.out {
        let json = serde_json::to_vec_pretty(&rows)?;
        std::fs::write(out, json).with_context(|| format!("cannot write {}", out.display()))?;
    }
    Ok(rows.iter().all(|row| row.failures.is_empty()))
}

fn run_one(scenario: &Scenario, context: &Context) -> Vec<Row> {
    eprintln!("chaos: {} begins: {}", scenario.name, scenario.about);
    let begun = Instant::now();
    let rows = (scenario.run)(context).unwrap_or_else(|error| {
        let mut row = Row::new(scenario.name, scenario.about);
        row.failures.push(format!("{error:#}"));
        vec![row]
    });
    let failures: usize = rows.iter().map(|row| row.failures.len()).sum();
    let secs = begun.elapsed().as_secs_f64();
    eprintln!(
        "chaos: {} ended after {secs:.0} s, failures: {failures}",
        scenario.name
    );
    rows
}
