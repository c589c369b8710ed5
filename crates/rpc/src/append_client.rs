//! Handing experience over, durably.

use std::sync::Arc;
use std::time::Duration;

use isodream_core::Chunk;
use isodream_proto::Identity;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::append_link::AppendLink;
use crate::link_state::LinkState;
use crate::spool::Spool;
use crate::{RpcError, replay_client};

/// Settings of an [`AppendClient`].
#[derive(Debug, Clone)]
pub struct AppendOptions {
    /// The replay-server, `host:port`.
    pub address: String,
    /// What this side works on.
    pub identity: Identity,
    /// Stable name of the actor.
    pub actor_id: String,
    /// Larger than at any earlier start of this actor, for example the start time: older ones are fenced off.
    pub epoch: u64,
    /// Unacknowledged chunks kept at most; [`AppendClient::send`] waits when they are reached.
    pub spool_chunks: usize,
}

/// Sends chunks to a replay-server and keeps each until it is durable there.
///
/// A task of its own reconnects for as long as the client lives and resends what was not acknowledged.
/// Dropping the client ends the task: call [`AppendClient::flush`] first.
#[derive(Debug)]
pub struct AppendClient {
    actor_id: String,
    epoch: u64,
    spool: Arc<Spool>,
    state: Arc<LinkState>,
    runtime: tokio::runtime::Handle,
    _task: DropGuard,
}

impl AppendClient {
    /// Starts the client; it connects in the background.
    ///
    /// # Errors
    /// [`RpcError::Address`] where the address cannot be one.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn start(options: AppendOptions) -> Result<Self, RpcError> {
        let client = replay_client(&options.address)?;
        let spool = Arc::new(Spool::new(options.spool_chunks));
        let state = Arc::new(LinkState::new(&format!(
            "replay-server {}",
            options.address
        )));
        let cancel = CancellationToken::new();
        let (actor_id, epoch) = (options.actor_id.clone(), options.epoch);
        let link = AppendLink {
            client,
            identity: options.identity,
            actor_id: options.actor_id,
            epoch: options.epoch,
            spool: spool.clone(),
            state: state.clone(),
        };
        let cancelled = cancel.clone();
        tokio::spawn(async move {
            tokio::select! {
                () = cancelled.cancelled() => link.state.end(link.state.closed()),
                () = link.run() => {}
            }
            link.spool.close();
        });
        Ok(Self {
            actor_id,
            epoch,
            spool,
            state,
            runtime: tokio::runtime::Handle::current(),
            _task: cancel.drop_guard(),
        })
    }

    /// Hands a chunk over; waits while the spool is full, which is what pauses the environments.
    ///
    /// Fills in the chunk's `actor_id`, `epoch` and `seq`. Dropping the future before it is done hands
    /// nothing over.
    ///
    /// # Errors
    /// [`RpcError::Refused`] where the server refused this client for good (other environment, newer epoch),
    /// [`RpcError::Closed`] after [`AppendClient::close`].
    pub async fn send(&self, mut chunk: Chunk) -> Result<(), RpcError> {
        chunk.actor_id.clone_from(&self.actor_id);
        chunk.epoch = self.epoch;
        if self.spool.push(chunk).await {
            return Ok(());
        }
        Err(self.state.ended().unwrap_or_else(|| self.state.closed()))
    }

    /// [`AppendClient::send`] for threads without a runtime.
    ///
    /// # Errors
    /// As [`AppendClient::send`].
    ///
    /// # Panics
    /// On a thread that drives async tasks.
    pub fn send_blocking(&self, chunk: Chunk) -> Result<(), RpcError> {
        self.runtime.block_on(self.send(chunk))
    }

    /// Why chunks are not moving, in words; none where they are.
    pub fn waiting(&self) -> Option<String> {
        self.state.waiting()
    }

    /// Why the client is at its end; none while it works.
    pub fn failed(&self) -> Option<RpcError> {
        self.state.ended()
    }

    /// Chunks that are not acknowledged yet.
    pub fn unacknowledged(&self) -> usize {
        self.spool.len()
    }

    /// Everything below this sequence number is durable.
    pub fn acknowledged_seq(&self) -> u64 {
        self.spool.acknowledged_seq()
    }

    /// Ends every waiting and future [`AppendClient::send`]; what was handed over is still delivered.
    pub fn close(&self) {
        self.spool.close();
    }

    /// Waits until everything handed over is durable, at most for `deadline`.
    ///
    /// # Errors
    /// [`RpcError::NotFlushed`] at the deadline, [`RpcError::Refused`] where the server refused this client.
    pub async fn flush(&self, deadline: Duration) -> Result<(), RpcError> {
        let flushed = async {
            loop {
                let acknowledged = self.spool.acknowledged.notified();
                tokio::pin!(acknowledged);
                acknowledged.as_mut().enable();
                if self.spool.len() == 0 {
                    return Ok(());
                }
                if let Some(error) = self.state.ended() {
                    return Err(error);
                }
                acknowledged.await;
            }
        };
        match tokio::time::timeout(deadline, flushed).await {
            Ok(result) => result,
            Err(_) => Err(RpcError::NotFlushed {
                peer: self.state.peer().to_owned(),
                chunks: self.spool.len(),
                deadline,
                why: self.waiting(),
            }),
        }
    }
}
