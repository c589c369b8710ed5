//! `isodream env serve`.

use std::thread::available_parallelism;

use clap::Args;
use isodream_rpc::EnvironmentServer;
use isodream_rpc::shutdown_on_signal;

use super::env_config;
use crate::output::print;
use crate::security::DoorArgs;

/// Options of `isodream env serve`.
#[derive(Debug, Args)]
pub(crate) struct ServeArgs {
    /// Id of the environments
    id: String,
    /// Where to listen; port 0 picks a free one
    #[arg(long, default_value = "127.0.0.1:0")]
    listen: String,
    /// How many environments; clients take as many as they ask for. Training takes those of all its actors and
    /// one for evaluation: actor.collectors x actor.environments + 1
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    environments: u16,
    /// A setting of the environments, for example env.vehicles=10; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    door: DoorArgs,
}

/// Serves until a signal to stop.
pub(super) async fn run(args: &ServeArgs) -> anyhow::Result<()> {
    let config = env_config(&args.id, &args.set)?;
    let mut environments = Vec::new();
    for _ in 0..args.environments {
        environments.push(isodream_envs::make(&config)?);
    }
    let server = EnvironmentServer::new(environments, available_parallelism()?)?;
    let door = args.door.door()?;
    let listener = isodream_rpc::bind(&args.listen, &door).await?;
    print(&format!("{} at grpc://{}", args.id, listener.local_addr()?))?;
    server.serve(listener, door, shutdown_on_signal()?).await?;
    Ok(())
}
