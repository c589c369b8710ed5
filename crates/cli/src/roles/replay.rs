//! The replay-server as a process.

use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use isodream_core::Config;
use isodream_core::config::{SelectorKind, TableConfig};
use isodream_replay::{Capacity, LimiterOptions, Selector, StoreOptions, Table};
use isodream_replay_server::{PolicySource, ServedTable, ServerOptions};
use isodream_rpc::{Door, Role};
use metrics_exporter_prometheus::PrometheusBuilder;

use super::RoleArgs;
use crate::security::DoorArgs;
use crate::store::StoreCommand;

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
    #[command(flatten)]
    door: DoorArgs,
    /// Where experience is stored
    #[arg(long, required = true)]
    dir: Option<PathBuf>,
    /// Where to listen
    #[arg(long, default_value = "127.0.0.1:7001")]
    listen: String,
    /// Where Prometheus finds metrics; nowhere by default
    #[arg(long)]
    metrics_listen: Option<SocketAddr>,
    /// The learner, or another relay: hand on its policies, so that actors can take this server for their --learner
    #[arg(long, value_name = "ADDRESS")]
    relay_policy: Option<String>,
}

/// Runs a replay-server until it is told to stop.
pub(crate) async fn replay(args: ServerArgs) -> anyhow::Result<()> {
    let config = args.role.config.load()?;
    let shutdown = args.role.shutdown()?;
    let door = args.door.door()?;
    let listener = isodream_rpc::bind(&args.listen, &door).await?;
    if let Some(address) = args.metrics_listen {
        PrometheusBuilder::new()
            .with_http_listener(address)
            .install()
            .with_context(|| format!("cannot serve metrics at {address}"))?;
    }
    // The parser asks for it unless there is a subcommand.
    let dir = args.dir.context("--dir is missing")?;
    let client = &args.door.client;
    let relay = |address| -> anyhow::Result<PolicySource> {
        // To the learner a relay is an actor; who is none needs no actor's token.
        let dialer = client.dialer(Role::Actor)?;
        Ok(PolicySource { address, dialer })
    };
    let options = ServerOptions {
        relay_policy: args.relay_policy.map(relay).transpose()?,
        ..server_options(&config, dir, door)
    };
    isodream_replay_server::serve(options, listener, shutdown).await
}

/// A setting whose 0 means that there is no limit.
fn limit(setting: u64) -> u64 {
    if setting == 0 { u64::MAX } else { setting }
}

fn server_options(config: &Config, folder: PathBuf, door: Door) -> ServerOptions {
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
        door,
        relay_policy: None,
        tables: config.replay.tables.iter().map(served_table).collect(),
    }
}

fn served_table((name, config): (&String, &TableConfig)) -> ServedTable {
    let selector = match config.selector {
        SelectorKind::Steps => Selector::Steps,
        SelectorKind::Episodes if config.ends_share > 0.0 => Selector::Ends {
            probability: config.ends_share,
        },
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
