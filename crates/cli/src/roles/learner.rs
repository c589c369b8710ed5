//! The learner as a process.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::bail;
use clap::{Args, ValueEnum};
use isodream_learner::{Finished, LearnerOptions};
use isodream_rpc::{ENVIRONMENT_PATIENCE, Role, environment_spec};

use super::RoleArgs;
use crate::security::DoorArgs;

/// Options of `isodream learner`.
#[derive(Debug, Args)]
pub(crate) struct LearnerArgs {
    #[command(flatten)]
    pub(crate) role: RoleArgs,
    #[command(flatten)]
    door: DoorArgs,
    /// Where checkpoints and metrics go
    #[arg(long)]
    run_dir: PathBuf,
    /// Where to listen
    #[arg(long, default_value = "127.0.0.1:7002")]
    listen: String,
    /// The replay-servers; a name may stand for several
    #[arg(long, value_delimiter = ',', default_value = "127.0.0.1:7001")]
    replay: Vec<String>,
    /// Where tensors live
    #[arg(long, value_enum, default_value_t = DeviceArg::Auto)]
    device: DeviceArg,
}

/// A device by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum DeviceArg {
    /// CUDA where there is one, else the CPU
    Auto,
    /// The CPU
    Cpu,
    /// The first CUDA device
    Cuda,
}

impl DeviceArg {
    pub(crate) fn resolve(self) -> anyhow::Result<tch::Device> {
        match self {
            Self::Auto => Ok(tch::Device::cuda_if_available()),
            Self::Cpu => Ok(tch::Device::Cpu),
            Self::Cuda if tch::Cuda::is_available() => Ok(tch::Device::Cuda(0)),
            Self::Cuda => bail!(
                "no CUDA device: libtorch finds none; preload libtorch_cuda.so of the same version, or use --device cpu"
            ),
        }
    }
}

/// Exit code of a supervised learner that stopped before its last update (EX_TEMPFAIL).
const STOPPED: u8 = 75;

/// Runs the learner until all updates are made or it is told to stop. Under a supervisor the two differ in
/// their exit code.
pub(crate) async fn learner(args: LearnerArgs) -> anyhow::Result<ExitCode> {
    let config = args.role.config.load()?;
    let shutdown = args.role.shutdown()?;
    let supervised = args.role.supervised;
    let dialer = args.door.client.dialer(Role::Learner)?;
    let door = args.door.door()?;
    let (env, dialing) = (config.env.clone(), dialer.clone());
    let asked = move || environment_spec(&dialing, &env, ENVIRONMENT_PATIENCE);
    let spec = tokio::task::spawn_blocking(asked).await??;
    let options = LearnerOptions {
        config,
        spec,
        run_dir: args.run_dir,
        listen: args.listen,
        replay: args.replay,
        dialer,
        door,
        device: args.device.resolve()?,
    };
    Ok(match isodream_learner::run(options, shutdown).await? {
        Finished::Stopped if supervised => ExitCode::from(STOPPED),
        Finished::Trained | Finished::Stopped => ExitCode::SUCCESS,
    })
}
