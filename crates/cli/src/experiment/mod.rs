//! `isodream experiment`: the paper's tables and figures, each by one command.
//!
//! An experiment is a file in `experiments/`: methods, tasks, tests, and how large it is at each scale. Running it
//! trains every method on every task with several seeds, each in a run directory of its own that another start of the
//! same command goes on with; reporting reads these directories.

mod definition;
mod evaluation;
mod plan;
mod report;
mod run;

use std::path::PathBuf;

use clap::{Args, Subcommand};

use self::definition::{Definition, Scale};
use crate::output::print;

/// What is done with experiments.
#[derive(Debug, Subcommand)]
pub(crate) enum ExperimentCommand {
    /// What there is
    List,
    /// Train and evaluate; the same command goes on where it was interrupted
    Run(RunArgs),
    /// Make a page and a text of what was run
    Report(ReportArgs),
}

/// Which experiment, how large, and where it lies.
#[derive(Debug, Args)]
pub(crate) struct Choice {
    /// Its name, as `list` tells it, or a file of one's own
    name: String,
    /// smoke: seconds, cpu: hours on a laptop, paper: days on a GPU
    #[arg(long, value_enum, default_value_t = Scale::Cpu)]
    scale: Scale,
    /// Where the runs lie
    #[arg(long, default_value = "runs/experiments")]
    out: PathBuf,
}

/// Options of `isodream experiment run`.
#[derive(Debug, Args)]
pub(crate) struct RunArgs {
    #[command(flatten)]
    choice: Choice,
    /// Runs at a time
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    parallel: u16,
    /// Only the first so many seeds
    #[arg(long)]
    seeds: Option<u64>,
    /// Only these methods, by name
    #[arg(long, value_delimiter = ',')]
    methods: Vec<String>,
    /// Only these tasks, by name
    #[arg(long, value_delimiter = ',')]
    tasks: Vec<String>,
}

/// Options of `isodream experiment report`.
#[derive(Debug, Args)]
pub(crate) struct ReportArgs {
    #[command(flatten)]
    choice: Choice,
    /// Newest points that each drawn value is the mean of
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..))]
    smooth: u16,
}

/// Runs the command.
pub(crate) async fn run(command: ExperimentCommand) -> anyhow::Result<()> {
    match command {
        ExperimentCommand::List => {
            let all = definition::all()?;
            let width = all.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
            for (name, definition) in all {
                print(&format!("{name:<width$}  {}", definition.title))?;
            }
            Ok(())
        }
        ExperimentCommand::Run(args) => run::run(&args).await,
        ExperimentCommand::Report(args) => {
            let folder = report::report(&args.choice, usize::from(args.smooth))?;
            print(&format!("{}", folder.join("report.md").display()))?;
            print(&format!("{}", folder.join("report.html").display()))
        }
    }
}

impl Choice {
    fn definition(&self) -> anyhow::Result<(String, Definition)> {
        definition::find(&self.name)
    }
}
