//! The replay-server as a process of the benchmark.

use anyhow::Context;
use isodream_replay::{Capacity, LimiterOptions, Selector, StoreOptions, Table};
use isodream_replay_server::{ServedTable, ServerOptions, serve};
use isodream_rpc::Door;
use serde::{Deserialize, Serialize};
use tokio_util::sync::CancellationToken;

use super::part::{Work, answer};
use super::probes;

/// The table that is drawn from.
pub(super) const TABLE: &str = "train";

/// What the server has used so far.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Usage {
    pub(super) cpu_seconds: f64,
    /// Memory of its own: without the page cache and mapped files.
    pub(super) own_bytes: u64,
}

pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Runtime::new()?;
    let listener = runtime.block_on(isodream_rpc::bind("127.0.0.1:0", &Door::default()))?;
    let address = listener.local_addr()?.to_string();
    let options = ServerOptions {
        folder: work.folder.clone(),
        store: StoreOptions {
            capacity: Capacity::UNLIMITED,
            segment_bytes: work.segment_bytes,
        },
        limiter: LimiterOptions {
            min_steps: 0,
            samples_per_insert: 0.0,
            tolerance_steps: 0.0,
        },
        relay_policy: None,
        tables: vec![ServedTable {
            table: Table::new(TABLE, Selector::Episodes),
            limited: false,
        }],
        door: Door::default(),
    };
    let shutdown = CancellationToken::new();
    let running = runtime.spawn(serve(options, listener, shutdown.clone()));
    answer(&address, |_| {
        Ok(Usage {
            cpu_seconds: probes::cpu_seconds(),
            own_bytes: probes::own_bytes()?,
        })
    })?;
    shutdown.cancel();
    runtime
        .block_on(running)
        .context("the task of the server died")?
}
