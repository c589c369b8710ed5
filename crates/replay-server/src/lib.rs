//! The replay service over the replay library: group commit, credits, waiting with reasons.
//!
//! One thread owns the writer: it collects whatever chunks have arrived, writes them, syncs
//! once and acknowledges. Streams admit chunks and draws through the rate limiter and tell their peer why they
//! wait. Only that thread and blocking tasks touch the disk.
//!
//! A server can hand on the learner's policies as well ([`ServerOptions::relay_policy`]), so that its actors need no
//! connection to the learner.
//!
//! A full disk holds inserts until there is room, while sampling goes on. Shutting down takes no more chunks,
//! stores and acknowledges those that have arrived, and then ends the streams with the reason.

mod append;
mod commit;
mod errors;
mod metrics;
mod sample;
mod service;
mod state;
mod tables;

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context;
use isodream_proto::v1::learner_service_server::LearnerServiceServer;
use isodream_proto::v1::replay_service_server::ReplayServiceServer;
use isodream_replay::{LimiterOptions, ReplayError, Store, StoreOptions};
use isodream_rpc::limits::MAX_MESSAGE_BYTES;
use isodream_rpc::{Dialer, Door, PolicyRelay, PolicyService, policy_service};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::transport::server::TcpIncoming;
use tonic_health::ServingStatus;

use crate::commit::Committer;
use crate::service::ReplayServer;
use crate::state::State;
use crate::tables::Tables;

pub use crate::tables::ServedTable;

/// Chunks between the streams and the commit thread at most; 200 KB each as a rule.
const COMMIT_QUEUE: usize = 64;

/// Settings of a replay-server.
#[derive(Debug, Clone)]
pub struct ServerOptions {
    /// The store's folder; made where it is missing, locked while the server runs.
    pub folder: PathBuf,
    /// Capacity and layout.
    pub store: StoreOptions,
    /// The ratio of sampled to inserted steps. Always today's: nothing of it is stored.
    pub limiter: LimiterOptions,
    /// What learners may draw from, each name once.
    pub tables: Vec<ServedTable>,
    /// Who may come in.
    pub door: Door,
    /// Whose policies are handed on; none serves experience alone.
    pub relay_policy: Option<PolicySource>,
}

/// The learner, or another relay, that policies come from.
#[derive(Debug, Clone)]
pub struct PolicySource {
    /// `host:port`.
    pub address: String,
    /// How it is reached.
    pub dialer: Dialer,
}

/// Whether `error` comes from a disk whose state is unknown, so that only a new process can go on. By convention
/// such a process ends with code 70.
pub fn is_disk_failure(error: &anyhow::Error) -> bool {
    error
        .chain()
        .filter_map(|cause| cause.downcast_ref::<ReplayError>())
        .any(ReplayError::is_fatal)
}

/// Serves the store in `options.folder` on `listener` until `shutdown` is cancelled. Dropping the future
/// stops the server as a crash would, and then releases the folder.
///
/// # Errors
/// Where the store cannot be opened, the server fails, or the disk fails in a way that leaves its state
/// unknown ([`is_disk_failure`]): then the process must end, and restarting recovers what is durable.
pub async fn serve(
    options: ServerOptions,
    listener: TcpListener,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    let address = listener
        .local_addr()
        .context("the listener has no address")?;
    tracing::info!(%address, "listening");
    let incoming = TcpIncoming::from(listener).with_nodelay(Some(true));
    serve_connections(options, incoming, shutdown).await
}

/// [`serve`] for connections from anywhere, for example a simulated network.
///
/// # Errors
/// As [`serve`].
pub async fn serve_connections<C: isodream_rpc::Connection>(
    options: ServerOptions,
    incoming: impl Stream<Item = std::io::Result<C>>,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    let tables = Tables::new(options.tables)?;
    let (folder, store_options) = (options.folder.clone(), options.store.clone());
    let (writer, store, recovery) =
        tokio::task::spawn_blocking(move || Store::open(&folder, &store_options))
            .await
            .context("the task that opens the replay store failed")??;
    let stats = store.stats();
    tracing::info!(
        folder = %options.folder.display(),
        steps = stats.steps,
        episodes = stats.episodes,
        inserted_steps = stats.inserted_steps,
        segments = recovery.segments,
        torn_bytes = recovery.torn_bytes,
        quarantined = recovery.quarantined.len(),
        "serving replay"
    );

    // Streams and the commit thread outlive this future's drop unless they are told.
    let stop = shutdown.child_token();
    let _stop_on_drop = stop.clone().drop_guard();
    let (commands, queue) = mpsc::channel(COMMIT_QUEUE);
    let store_id = writer.store_id().to_owned();
    let relay_name = format!("relay {store_id}");
    let state = Arc::new(State::new(
        store,
        store_id,
        tables,
        options.limiter,
        commands,
        stop.clone(),
    ));
    let mut committed = Committer::new(writer, queue, state.clone())
        .spawn()
        .context("cannot start the commit thread")?;
    let (health, health_service) = tonic_health::server::health_reporter();
    health
        .set_serving::<ReplayServiceServer<ReplayServer>>()
        .await;
    let (draining, reporter) = (stop.clone(), health.clone());
    tokio::spawn(async move {
        draining.cancelled().await;
        reporter
            .set_not_serving::<ReplayServiceServer<ReplayServer>>()
            .await;
        // The server as a whole.
        reporter
            .set_service_status("", ServingStatus::NotServing)
            .await;
    });

    metrics::start(state.clone(), stop.clone());
    let service = ReplayServiceServer::new(ReplayServer::new(state))
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES);
    let relay = match &options.relay_policy {
        Some(PolicySource { address, dialer }) => {
            let relay = PolicyRelay::new(dialer, address, relay_name, stop.clone())?;
            health
                .set_serving::<LearnerServiceServer<PolicyService<PolicyRelay>>>()
                .await;
            tracing::info!(learner = address, "handing on policies");
            Some(policy_service(relay, stop.clone()))
        }
        None => None,
    };
    let router = isodream_rpc::server(&options.door)?
        .add_service(health_service)
        .add_optional_service(relay)
        .add_service(service);
    let served = isodream_rpc::serve_connections(router, incoming, stop.clone());
    tokio::pin!(served);
    let result = tokio::select! {
        result = &mut served => {
            stop.cancel();
            committed.await.context("the commit thread died")?.context("the replay log failed")?;
            result.context("the replay-server failed")
        }
        result = &mut committed => {
            stop.cancel();
            // Open streams hear of the end before the process goes.
            if let Err(error) = served.await {
                tracing::warn!(%error, "the server did not stop cleanly");
            }
            match result {
                Ok(Ok(())) => Ok(()),
                Ok(Err(error)) => Err(error).context("the replay log failed"),
                Err(_) => Err(anyhow::anyhow!("the commit thread died")),
            }
        }
    };
    tracing::info!("replay stopped");
    result
}
