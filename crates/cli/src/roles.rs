//! One role per process.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use isodream_actor::ActorOptions;
use isodream_core::Config;
use isodream_core::config::{SelectorKind, TableConfig};
use isodream_learner::{Finished, LearnerOptions};
use isodream_replay::{Capacity, LimiterOptions, Selector, StoreOptions, Table};
use isodream_replay_server::{ServedTable, ServerOptions};
use isodream_rpc::{ENVIRONMENT_PATIENCE, environment_spec, shutdown_on_signal};
use metrics_exporter_prometheus::PrometheusBuilder;
use tokio_util::sync::CancellationToken;

use crate::config_args::ConfigArgs;
use crate::store::StoreCommand;

/// What all roles take.
#[derive(Debug, Args)]
pub(crate) struct RoleArgs {
    #[command(flatten)]
    config: ConfigArgs,
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

/// Options of `isodream replay`.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub(crate) struct ReplayArgs {
    #[command(subcommand)]
    pub(crate) command: Option<StoreCommand>,
    #[command(flatten)]
    pub(crate) server: ServerArgs,
}

/// Options of a replay-server.
#[derive(Debug, Args)]
pub(crate) struct ServerArgs {
    #[command(flatten)]
    role: RoleArgs,
    /// Where experience is stored
    #[arg(long, required = true)]
    dir: Option<PathBuf>,
    /// Where to listen
    #[arg(long, default_value = "127.0.0.1:7001")]
    listen: String,
    /// Where Prometheus finds metrics; nowhere by default
    #[arg(long)]
    metrics_listen: Option<SocketAddr>,
}

/// Options of `isodream learner`.
#[derive(Debug, Args)]
pub(crate) struct LearnerArgs {
    #[command(flatten)]
    role: RoleArgs,
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
    /// What the actor is for
    #[arg(long = "role", value_enum, default_value_t = Role::Collect)]
    kind: Role,
    /// Name, unique in the run
    #[arg(long)]
    id: String,
    /// The replay-servers; a name may stand for several
    #[arg(long, value_delimiter = ',', default_value = "127.0.0.1:7001")]
    replay: Vec<String>,
    /// The learner
    #[arg(long, default_value = "127.0.0.1:7002")]
    learner: String,
}

/// Runs a replay-server until it is told to stop.
pub(crate) async fn replay(args: ServerArgs) -> anyhow::Result<()> {
    let config = args.role.config.load()?;
    let shutdown = args.role.shutdown()?;
    let listener = isodream_rpc::bind(&args.listen).await?;
    if let Some(address) = args.metrics_listen {
        PrometheusBuilder::new()
            .with_http_listener(address)
            .install()
            .with_context(|| format!("cannot serve metrics at {address}"))?;
    }
    // The parser asks for it unless there is a subcommand.
    let dir = args.dir.context("--dir is missing")?;
    isodream_replay_server::serve(server_options(&config, dir), listener, shutdown).await
}

/// A setting whose 0 means that there is no limit.
fn limit(setting: u64) -> u64 {
    if setting == 0 { u64::MAX } else { setting }
}

fn server_options(config: &Config, folder: PathBuf) -> ServerOptions {
    let batches = config.replay.limiter_tolerance_batches;
    ServerOptions {
        folder,
        store: StoreOptions {
            capacity: Capacity {
                steps: limit(config.replay.capacity_steps),
                bytes: limit(config.replay.capacity_mb.saturating_mul(1_000_000)),
            },
            segment_bytes: config.replay.segment_bytes,
        },
        limiter: LimiterOptions {
            min_steps: config.learner.prefill_steps,
            samples_per_insert: config.samples_per_insert(),
            tolerance_steps: batches * config.batch_steps() as f64,
        },
        tables: config.replay.tables.iter().map(served_table).collect(),
    }
}

fn served_table((name, config): (&String, &TableConfig)) -> ServedTable {
    let selector = match config.selector {
        SelectorKind::Steps => Selector::Steps,
        SelectorKind::Episodes => Selector::Episodes,
        SelectorKind::Prioritized => Selector::Prioritized {
            exponent: config.priority_exponent,
        },
        SelectorKind::Fifo => Selector::Fifo,
        SelectorKind::Recent => Selector::Recent {
            newest: config.newest,
            probability: config.newest_share,
        },
    };
    ServedTable {
        table: Table::new(name, selector),
        limited: config.limited,
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
    let env = config.env.clone();
    let spec =
        tokio::task::spawn_blocking(move || environment_spec(&env, ENVIRONMENT_PATIENCE)).await??;
    let options = LearnerOptions {
        config,
        spec,
        run_dir: args.run_dir,
        listen: args.listen,
        replay: args.replay,
        device: args.device.resolve()?,
    };
    Ok(match isodream_learner::run(options, shutdown).await? {
        Finished::Stopped if supervised => ExitCode::from(STOPPED),
        Finished::Trained | Finished::Stopped => ExitCode::SUCCESS,
    })
}

/// Runs one actor until it is told to stop.
pub(crate) async fn actor(args: ActorArgs) -> anyhow::Result<()> {
    let config = args.role.config.load()?;
    let shutdown = args.role.shutdown()?;
    let options = ActorOptions {
        config,
        actor_id: args.id,
        replay: args.replay,
        learner: args.learner,
    };
    match args.kind {
        Role::Collect => isodream_actor::collect::run(options, shutdown).await,
        Role::Evaluate => isodream_actor::evaluate::run(options, shutdown).await,
    }
}
