//! `isodream bench`: how fast the parts are on this machine. Everything that is compared with something else is
//! measured in the same run.

#[cfg(feature = "torch")]
mod actor;
mod frames;
#[cfg(feature = "torch")]
mod learner;
mod load;
#[cfg(feature = "torch")]
mod machine;
mod replay;

use clap::Subcommand;

/// What to measure.
#[derive(Debug, Subcommand)]
pub(crate) enum BenchCommand {
    /// Training steps of the learner, by phase, beside the machine's own matrix products
    #[cfg(feature = "torch")]
    Learner(learner::LearnerBenchArgs),
    /// Decisions of the deployed policy: latency and environment steps per CPU second
    #[cfg(feature = "torch")]
    Actor(actor::ActorBenchArgs),
    /// Insertion and sampling through a replay-server, beside what memory, loopback and disk can do
    Replay(replay::ReplayBenchArgs),
    /// Synthetic actors against replay-servers and a learner's door: how many they hold, and how fast policies spread
    Load(Box<load::LoadArgs>),
    /// The learner's door of the load generator
    #[command(hide = true)]
    LoadDoor(load::DoorArgs),
    /// One process of the replay benchmark
    #[command(hide = true)]
    ReplayPart(replay::PartArgs),
}

/// Runs the command.
pub(crate) fn run(command: &BenchCommand) -> anyhow::Result<()> {
    match command {
        #[cfg(feature = "torch")]
        BenchCommand::Learner(args) => learner::run(args),
        #[cfg(feature = "torch")]
        BenchCommand::Actor(args) => actor::run(args),
        BenchCommand::Replay(args) => replay::run(args),
        BenchCommand::Load(args) => load::run(args),
        BenchCommand::LoadDoor(args) => load::run_door(args),
        BenchCommand::ReplayPart(args) => replay::run_part(args),
    }
}
