//! An actor as a process.

use anyhow::ensure;
use clap::{Args, ValueEnum};
use isodream_actor::ActorOptions;
use isodream_rpc::Role as TokenRole;

use super::RoleArgs;
use crate::security::ClientArgs;

/// What an actor is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Role {
    /// Sample actions and append every step to replay
    Collect,
    /// Take the most likely actions and report scores
    Evaluate,
}

/// Options of `isodream actor`.
#[derive(Debug, Args)]
pub(crate) struct ActorArgs {
    #[command(flatten)]
    role: RoleArgs,
    #[command(flatten)]
    security: ClientArgs,
    /// What the actor is for
    #[arg(long = "role", value_enum, default_value_t = Role::Collect)]
    kind: Role,
    /// Name, unique in the run; the host's name by default
    #[arg(long)]
    id: Option<String>,
    /// The replay-servers; a name may stand for several
    #[arg(long, value_delimiter = ',', default_value = "127.0.0.1:7001")]
    replay: Vec<String>,
    /// The learner
    #[arg(long, default_value = "127.0.0.1:7002")]
    learner: String,
}

/// Runs one actor until it is told to stop.
pub(crate) async fn actor(args: ActorArgs) -> anyhow::Result<()> {
    let config = args.role.config.load()?;
    let shutdown = args.role.shutdown()?;
    let options = ActorOptions {
        config,
        actor_id: args.id.map_or_else(host_name, Ok)?,
        dialer: args.security.dialer(TokenRole::Actor)?,
        replay: args.replay,
        learner: args.learner,
    };
    match args.kind {
        Role::Collect => isodream_actor::collect::run(options, shutdown).await,
        Role::Evaluate => isodream_actor::evaluate::run(options, shutdown).await,
    }
}

fn host_name() -> anyhow::Result<String> {
    let name = rustix::system::uname();
    let name = name.nodename().to_str().unwrap_or_default();
    ensure!(
        !name.is_empty(),
        "this host has no name that could be the actor's; give --id"
    );
    Ok(name.to_owned())
}
