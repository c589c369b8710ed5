//! Iso-Dream++: world models with isolated imaginations, distributed.
//!
//! `isodream train` starts every role as a process of its own on this machine; `replay`, `learner` and `actor`
//! start one role, anywhere. `eval`, `imagine`, `report` and `dashboard` look at what a run has learned.

mod bench;
mod chart;
mod config_args;
mod config_reference;
#[cfg(feature = "torch")]
mod counterfactual;
mod dashboard;
mod doctor;
mod env;
#[cfg(feature = "torch")]
mod eval;
#[cfg(feature = "torch")]
mod experiment;
mod health;
#[cfg(feature = "torch")]
mod imagine;
mod output;
mod report;
mod roles;
mod secrets;
mod security;
mod store;
#[cfg(feature = "torch")]
mod train;
#[cfg(feature = "torch")]
mod tuning;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
#[cfg(feature = "torch")]
use config_args::ConfigArgs;
use isodream_telemetry::{LogFormat, Logging, init_logging};

/// Model-based reinforcement learning with isolated imaginations (Iso-Dream++)
#[derive(Debug, Parser)]
#[command(name = "isodream", version, about)]
struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Train: start all roles on this machine, show progress, end with a summary. The same command resumes
    #[cfg(feature = "torch")]
    Train(train::TrainArgs),
    /// Run one replay-server, or look into its folder
    Replay(roles::ReplayArgs),
    /// Run the learner
    #[cfg(feature = "torch")]
    Learner(roles::LearnerArgs),
    /// Run one actor
    #[cfg(feature = "torch")]
    Actor(roles::ActorArgs),
    /// Compare a trained policy with scripted drivers on the same seeds
    #[cfg(feature = "torch")]
    Eval(eval::EvalArgs),
    /// Draw what the world model predicts, and measure how well its branches separate
    #[cfg(feature = "torch")]
    Imagine(imagine::ImagineArgs),
    /// The paper's tables and figures, each by one command
    #[cfg(feature = "torch")]
    #[command(subcommand)]
    Experiment(experiment::ExperimentCommand),
    /// Show runs in a browser page, while they train and afterwards
    Dashboard(dashboard::DashboardArgs),
    /// Draw the learning curves of runs
    Report(report::ReportArgs),
    /// Look at configurations
    #[command(subcommand)]
    Config(config_reference::ConfigCommand),
    /// Check this machine: processor, memory, disk, libraries, ports
    Doctor(doctor::DoctorArgs),
    /// Make certificates and tokens for a run over several machines
    Secrets(secrets::SecretsArgs),
    /// Ask a server whether it serves
    Health(health::HealthArgs),
    /// Look at environments, and measure them
    #[command(subcommand)]
    Env(env::EnvCommand),
    /// Measure how fast the parts are on this machine
    #[command(subcommand)]
    Bench(bench::BenchCommand),
}

impl Command {
    /// The configuration of a command whose own process trains.
    #[cfg(feature = "torch")]
    fn training(&self) -> Option<&ConfigArgs> {
        match self {
            Self::Learner(args) => Some(&args.role.config),
            Self::Bench(bench::BenchCommand::Learner(args)) => Some(&args.config),
            _ => None,
        }
    }

    /// By which a process of this command is known to those who collect traces.
    fn service(&self) -> &'static str {
        match self {
            Self::Replay(_) => "isodream-replay",
            #[cfg(feature = "torch")]
            Self::Learner(_) => "isodream-learner",
            #[cfg(feature = "torch")]
            Self::Actor(_) => "isodream-actor",
            _ => "isodream",
        }
    }
}

fn main() -> ExitCode {
    let args = Args::parse();
    match run(args.command) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            exit_code(&error)
        }
    }
}

/// Of a process whose disk failed in a way that only a new start can recover from (EX_SOFTWARE).
const DISK_FAILED: u8 = 70;

fn exit_code(error: &anyhow::Error) -> ExitCode {
    if isodream_replay_server::is_disk_failure(error) {
        ExitCode::from(DISK_FAILED)
    } else {
        ExitCode::FAILURE
    }
}

fn run(command: Command) -> anyhow::Result<ExitCode> {
    #[cfg(feature = "torch")]
    if let Some(Ok(config)) = command.training().map(ConfigArgs::load) {
        // Without them training is slower, but no less right.
        let _ = tuning::ensure(config.learner.workers);
    }
    let filter = match &command {
        #[cfg(feature = "torch")]
        Command::Train(_) => "warn",
        Command::Env(_) | Command::Bench(_) | Command::Health(_) | Command::Doctor(_) => "warn",
        _ => "info",
    };
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let logging = {
        let _entered = runtime.enter();
        init_logging(filter, LogFormat::Text, command.service())?
    };
    let result = match command {
        #[cfg(feature = "torch")]
        Command::Train(args) => runtime.block_on(train::run(args)),
        Command::Replay(args) => match args.command {
            Some(command) => store::run(&command),
            None => runtime.block_on(roles::replay(args.server)),
        },
        #[cfg(feature = "torch")]
        Command::Learner(args) => {
            return finish(runtime.block_on(roles::learner(args)), logging, runtime);
        }
        #[cfg(feature = "torch")]
        Command::Actor(args) => runtime.block_on(roles::actor(args)),
        #[cfg(feature = "torch")]
        Command::Eval(args) => eval::run(&args),
        #[cfg(feature = "torch")]
        Command::Imagine(args) => imagine::run(&args),
        #[cfg(feature = "torch")]
        Command::Experiment(command) => runtime.block_on(experiment::run(command)),
        Command::Dashboard(args) => runtime.block_on(dashboard::run(args)),
        Command::Report(args) => report::run(&args),
        Command::Config(command) => config_reference::run(&command),
        Command::Doctor(args) => doctor::run(&args),
        Command::Secrets(args) => secrets::run(&args),
        Command::Health(args) => runtime.block_on(health::run(args)),
        Command::Env(command) => env::run(&command, &runtime),
        Command::Bench(command) => bench::run(&command),
    };
    finish(result.map(|()| ExitCode::SUCCESS), logging, runtime)
}

/// Sends the last spans and ends the runtime without waiting: a reader of standard input cannot be interrupted.
fn finish(
    result: anyhow::Result<ExitCode>,
    logging: Logging,
    runtime: tokio::runtime::Runtime,
) -> anyhow::Result<ExitCode> {
    drop(logging);
    runtime.shutdown_background();
    result
}
