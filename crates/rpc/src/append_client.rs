//! Handing experience over, durably.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use isodream_core::Chunk;
use isodream_proto::Identity;
use rand::RngExt;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::append_link::Sender;
use crate::append_route::AppendRoute;
use crate::link_state::{Ending, LinkState};
use crate::spool::{AcknowledgedChunks, Bounds, Spool};
use crate::{Dialer, RpcError};

/// Settings of an [`AppendClient`].
#[derive(Debug, Clone)]
pub struct AppendOptions {
    /// The replay-servers, `host:port`; a name that stands for several means all of them.
    pub addresses: Vec<String>,
    /// What this side works on.
    pub identity: Identity,
    /// Stable name of the actor.
    pub actor_id: String,
    /// Unacknowledged chunks kept at most; [`AppendClient::send`] waits when they are reached.
    pub spool_chunks: usize,
    /// Unacknowledged bytes kept at most, as chunks are encoded; a single chunk always has room.
    pub spool_bytes: usize,
    /// How long the server may stay away before the client turns to the next, if there is one
    /// ([`crate::limits::FAILOVER_AFTER`]).
    pub failover_after: Duration,
}

/// Sends chunks to one of several replay-servers and keeps each until it is durable there.
///
/// A task of its own reconnects for as long as the client lives and resends what was not acknowledged.
/// Dropping the client ends the task: call [`AppendClient::flush`] first.
///
/// # Exactly once over several servers
/// The client stays with one server, chosen by its name, until that stays away for
/// [`AppendOptions::failover_after`]; then it sends new chunks to the next, and stays there. Whether a server
/// that went away stored the last chunks it was sent cannot be known before it is back, so these wait for it
/// (each store has its own numbers) and are never sent to another: no step is stored twice. They are lost only
/// if that server never returns while this client lives; of all servers that are away, they are never more than
/// one spool.
/// An episode that is running at that moment is split, and the second server's part begins in its middle.
/// The first server that a client reaches hands out its epoch, greater than any before of this actor as far as the
/// servers' clocks agree, so that no clock of an actor's machine counts. Older processes of the same actor are fenced
/// off at the server that the new one uses.
#[derive(Debug)]
pub struct AppendClient {
    actor_id: String,
    peers: String,
    spool: Arc<Spool>,
    current: Arc<Mutex<Arc<LinkState>>>,
    ending: Arc<Ending>,
    runtime: tokio::runtime::Handle,
    _task: DropGuard,
}

impl AppendClient {
    /// Starts the client; it connects in the background.
    ///
    /// # Errors
    /// [`RpcError::Address`] where an address cannot be one or there is none, [`RpcError::Tls`] where the dialer's
    /// certificates make no sense.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn start(dialer: &Dialer, options: AppendOptions) -> Result<Self, RpcError> {
        let peers = check_addresses(dialer, &options.addresses)?;
        let spool = Arc::new(Spool::new(Bounds {
            chunks: options.spool_chunks,
            bytes: options.spool_bytes,
        }));
        let current = Arc::new(Mutex::new(Arc::new(LinkState::new(&peers))));
        let ending = Arc::new(Ending::default());
        let cancel = CancellationToken::new();
        let actor_id = options.actor_id.clone();
        let sender = Sender {
            identity: options.identity,
            actor_id: options.actor_id,
            process: rand::rng().random(),
            epoch: OnceLock::new(),
        };
        let route = AppendRoute::new(
            dialer.clone(),
            options.addresses,
            options.failover_after,
            sender,
            spool.clone(),
            current.clone(),
        );
        let cancelled = cancel.clone();
        let (closed, ended) = (Closed(spool.clone()), ending.clone());
        tokio::spawn(async move {
            let _closed = closed;
            tokio::select! {
                () = cancelled.cancelled() => {}
                error = route.run() => ended.set(error),
            }
        });
        Ok(Self {
            actor_id,
            peers,
            spool,
            current,
            ending,
            runtime: tokio::runtime::Handle::current(),
            _task: cancel.drop_guard(),
        })
    }

    /// Hands a chunk over; waits while the spool is full, which is what pauses the environments.
    ///
    /// Fills in the chunk's `actor_id`; its `epoch` and `seq` follow when it is sent. Dropping the future before it is done hands
    /// nothing over.
    ///
    /// # Errors
    /// [`RpcError::Refused`] where the server refused this client for good (other environment, newer epoch),
    /// [`RpcError::Closed`] after [`AppendClient::close`].
    pub async fn send(&self, mut chunk: Chunk) -> Result<(), RpcError> {
        chunk.actor_id.clone_from(&self.actor_id);
        if self.spool.push(chunk).await {
            return Ok(());
        }
        Err(self.failed().unwrap_or_else(|| RpcError::Closed {
            peer: format!("replay-server {}", self.peers),
        }))
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
        if let Some(error) = self.failed() {
            return Some(error.to_string());
        }
        let current = self.current.lock().unwrap_or_else(PoisonError::into_inner);
        current.waiting()
    }

    /// The stores that chunks wait for besides the one that new chunks go to, in words.
    fn left_behind(&self) -> Option<String> {
        let stores = self.spool.left_behind();
        let left = || format!("chunks wait for the store {}", stores.join(", "));
        (!stores.is_empty()).then(left)
    }

    /// Why the client is at its end; none while it works.
    pub fn failed(&self) -> Option<RpcError> {
        self.ending.get()
    }

    /// Chunks that are not acknowledged yet.
    pub fn unacknowledged(&self) -> usize {
        self.spool.len()
    }

    /// Chunks that are durable.
    pub fn acknowledged_chunks(&self) -> u64 {
        self.spool.acknowledged()
    }

    /// Tells `observer` of every chunk that becomes durable: call it before the first [`AppendClient::send`]. Only
    /// the first observer counts.
    pub fn observe(&self, observer: Arc<dyn AcknowledgedChunks>) {
        self.spool.observe(observer);
    }

    /// Ends every waiting and future [`AppendClient::send`]; what was handed over is still delivered.
    pub fn close(&self) {
        self.spool.close();
    }

    /// Waits until everything handed over is durable, at most for `deadline`.
    ///
    /// # Errors
    /// [`RpcError::NotFlushed`] at the deadline, [`RpcError::GivenUp`] where servers that went away took chunks
    /// with them, [`RpcError::Refused`] where the server refused this client.
    pub async fn flush(&self, deadline: Duration) -> Result<(), RpcError> {
        let flushed = async {
            let mut changes = self.spool.changes();
            loop {
                changes.borrow_and_update();
                if self.spool.len() == 0 {
                    return match self.spool.given_up() {
                        0 => Ok(()),
                        chunks => Err(RpcError::GivenUp { chunks }),
                    };
                }
                if let Some(error) = self.failed() {
                    return Err(error);
                }
                // The spool lives as long as this client.
                let _ = changes.changed().await;
            }
        };
        match tokio::time::timeout(deadline, flushed).await {
            Ok(result) => result,
            Err(_) => Err(RpcError::NotFlushed {
                peer: format!("replay-server {}", self.peers),
                chunks: self.spool.len(),
                deadline,
                why: self.waiting().or_else(|| self.left_behind()),
            }),
        }
    }
}

/// Closes a spool when it is dropped, also by a panic: nobody may wait for a task that is gone.
struct Closed(Arc<Spool>);

impl Drop for Closed {
    fn drop(&mut self) {
        self.0.close();
    }
}

/// The addresses in words, if each can be one.
pub(crate) fn check_addresses(dialer: &Dialer, addresses: &[String]) -> Result<String, RpcError> {
    if addresses.is_empty() {
        return Err(RpcError::Address {
            address: String::new(),
            reason: "no replay-server is given".to_owned(),
        });
    }
    for address in addresses {
        dialer.replay(address)?;
    }
    Ok(addresses.join(", "))
}
