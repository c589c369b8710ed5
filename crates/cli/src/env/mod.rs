//! `isodream env`: the worlds themselves, without learning.

mod bench;
mod drivers;
mod list;
#[cfg(feature = "torch")]
mod play;
mod serve;
#[cfg(feature = "mujoco")]
mod verify;

use clap::Subcommand;
use isodream_core::Config;
use isodream_core::config::{EnvConfig, Source};
use isodream_envs::Environment;
use isodream_rpc::{Dialer, RemoteEnvironment, RemoteOptions, remote_address};
use tokio::runtime::Runtime;

/// What to do with environments.
#[derive(Debug, Subcommand)]
pub(crate) enum EnvCommand {
    /// The ids of all environments
    List(list::ListArgs),
    /// Watch an episode: a video, an animation or a contact sheet
    #[cfg(feature = "torch")]
    Play(play::PlayArgs),
    /// Let another process drive environments, over gRPC
    Serve(serve::ServeArgs),
    /// What scripted drivers earn on the highway, and what looking and looking ahead are worth
    Drivers(drivers::DriversArgs),
    /// Frames and simulator steps per second
    Bench(bench::BenchArgs),
    /// DeepMind Control against dm_control, and whether traffic keeps clear of itself
    #[cfg(feature = "mujoco")]
    Verify(verify::VerifyArgs),
}

/// Runs the command.
pub(crate) fn run(command: &EnvCommand, runtime: &Runtime) -> anyhow::Result<()> {
    match command {
        EnvCommand::List(args) => list::run(args),
        #[cfg(feature = "torch")]
        EnvCommand::Play(args) => play::run(args),
        EnvCommand::Serve(args) => runtime.block_on(serve::run(args)),
        EnvCommand::Drivers(args) => drivers::run(args),
        EnvCommand::Bench(args) => bench::run(args),
        #[cfg(feature = "mujoco")]
        EnvCommand::Verify(args) => verify::run(args),
    }
}

/// The paper's settings for the environment `id`, with `set` over them.
fn env_config(id: &str, set: &[String]) -> anyhow::Result<EnvConfig> {
    let preset = if id.starts_with("dmc/") {
        "paper-dmc"
    } else {
        "paper"
    };
    let mut all = set.to_vec();
    all.push(format!("env.id=\"{id}\""));
    let config = Config::load(&Source {
        preset: Some(preset.to_owned()),
        file: None,
        set: all,
    })?;
    Ok(config.env)
}

/// The environment of `config`, in this process or, for an id `grpc://host:port`, in another one, and then as it
/// is there.
fn open(dialer: &Dialer, config: &EnvConfig) -> anyhow::Result<Box<dyn Environment>> {
    match remote_address(&config.id) {
        Some(address) => {
            let remote = RemoteEnvironment::connect(dialer, address, RemoteOptions::default())?;
            Ok(Box::new(remote))
        }
        None => Ok(isodream_envs::make(config)?),
    }
}
