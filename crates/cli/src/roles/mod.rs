//! One role per process.

#[cfg(feature = "torch")]
mod actor;
#[cfg(feature = "torch")]
mod learner;
mod replay;

use clap::Args;
use isodream_rpc::shutdown_on_signal;
use tokio_util::sync::CancellationToken;

use crate::config_args::ConfigArgs;

#[cfg(feature = "torch")]
pub(crate) use actor::{ActorArgs, actor};
#[cfg(feature = "torch")]
pub(crate) use learner::{DeviceArg, LearnerArgs, learner};
pub(crate) use replay::{ReplayArgs, replay};

/// What all roles take.
#[derive(Debug, Args)]
pub(crate) struct RoleArgs {
    #[command(flatten)]
    pub(crate) config: ConfigArgs,
    /// Stop when standard input closes, as it does when the process that started this one dies
    #[arg(long)]
    supervised: bool,
}

impl RoleArgs {
    /// A token that a signal cancels, or the end of the supervisor.
    fn shutdown(&self) -> anyhow::Result<CancellationToken> {
        let token = shutdown_on_signal()?;
        if self.supervised {
            let cancelled = token.clone();
            std::thread::Builder::new()
                .name("supervision".into())
                .spawn(move || {
                    // Nothing is ever written: reading returns when the other end is gone.
                    let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
                    cancelled.cancel();
                })?;
        }
        Ok(token)
    }
}
