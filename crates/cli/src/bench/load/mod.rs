//! `isodream bench load`: what replay-servers and a learner's door hold, under synthetic actors.
//!
//! Actors are tasks of this process, each with the connections and the traffic of a real one: recorded chunks at a
//! given pace, a watch on the policy that fetches and verifies every version, and a report per episode. Servers are
//! processes: the ones that are named, or own ones on loopback with the learner's door beside them.

mod actor;
mod board;
mod commits;
mod door;
mod process;
mod result;
mod run;
mod sampler;
mod servers;

use std::path::PathBuf;

use anyhow::ensure;
use clap::Args;

pub(crate) use self::door::DoorArgs;
pub(super) use self::door::run as run_door;
use self::result::LoadBench;
use crate::config_args::ConfigArgs;
use crate::output::print_result;
use crate::security::ClientArgs;

/// Options of `isodream bench load`.
#[derive(Debug, Args)]
pub(crate) struct LoadArgs {
    #[command(flatten)]
    config: ConfigArgs,
    /// Synthetic actors
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u64).range(1..))]
    actors: u64,
    /// Seconds of the measurement, once all actors have joined
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Steps per second of each actor; 0 appends as fast as chunks become durable
    #[arg(long, default_value_t = 25.0)]
    steps_per_second: f64,
    /// Replay-servers that run already, of the same configuration; own ones by default
    #[arg(long, value_delimiter = ',', requires = "learner")]
    replay: Vec<String>,
    /// The learner, or a relay, that runs already; an own door by default
    #[arg(long, requires = "replay")]
    learner: Option<String>,
    /// Own replay-servers
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    servers: u16,
    /// Own replay-servers hand on the policies, and actors follow these instead of the door
    #[arg(long, conflicts_with = "learner")]
    relay: bool,
    /// Learners that draw batches beside, at the configuration's ratio. Without them, no ratio is kept by own servers
    #[arg(long, default_value_t = 0)]
    learners: u16,
    /// Seconds between two policies of the own door
    #[arg(long, default_value_t = 5.0)]
    publish_seconds: f64,
    /// Bytes of a policy of the own door; the default is that of the paper's size
    #[arg(long, default_value_t = 17_000_000)]
    policy_bytes: usize,
    /// Different episodes, appended again and again
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Steps per episode
    #[arg(long, default_value_t = 500, value_parser = clap::value_parser!(u16).range(1..))]
    episode_steps: u16,
    /// Seconds that all actors may take to join
    #[arg(long, default_value_t = 120.0)]
    join_seconds: f64,
    /// Folder for the experience of own servers, on the disk to be measured; it is emptied afterwards
    #[arg(long, default_value = "runs/bench-load")]
    dir: PathBuf,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    security: ClientArgs,
}

/// Runs the command.
pub(super) fn run(args: &LoadArgs) -> anyhow::Result<()> {
    ensure!(
        args.seconds > 0.0 && args.publish_seconds > 0.0 && args.steps_per_second >= 0.0,
        "--seconds and --publish-seconds must be greater than 0, --steps-per-second at least 0"
    );
    let runtime = tokio::runtime::Runtime::new()?;
    let result = runtime.block_on(run::measure(args))?;
    print_result(&result, args.json, LoadBench::table)
}
