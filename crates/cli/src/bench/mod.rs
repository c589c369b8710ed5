//! `isodream bench`: how fast the parts are on this machine. Everything that is compared with something else is
//! measured in the same run.

mod actor;
mod learner;
mod machine;

use clap::Subcommand;

/// What to measure.
#[derive(Debug, Subcommand)]
pub(crate) enum BenchCommand {
    /// Training steps of the learner, by phase, beside the machine's own matrix products
    Learner(learner::LearnerBenchArgs),
    /// Decisions of the deployed policy: latency and environment steps per CPU second
    Actor(actor::ActorBenchArgs),
}

/// Runs the command.
pub(crate) fn run(command: &BenchCommand) -> anyhow::Result<()> {
    match command {
        BenchCommand::Learner(args) => learner::run(args),
        BenchCommand::Actor(args) => actor::run(args),
    }
}
