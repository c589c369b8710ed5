//! One replay-server of an [`crate::AppendClient`].

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use isodream_core::Chunk;
use isodream_proto::v1::append_request::Kind;
use isodream_proto::v1::{AppendRequest, Hello, ReplayStatusRequest};
use isodream_proto::{Identity, v1};
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

use crate::error::words;
use crate::limits::RECONNECT_DELAYS;
use crate::link_state::LinkState;
use crate::spool::Spool;
use crate::{ReplayClient, RpcError, is_refusal, reconnect_delays};

/// Chunks handed to the transport ahead of its pace.
const IN_FLIGHT_CHUNKS: usize = 4;

/// Who sends: the same on every link of a client.
#[derive(Debug)]
pub(crate) struct Sender {
    pub(crate) identity: Identity,
    pub(crate) actor_id: String,
    /// Drawn at the start.
    pub(crate) process: u64,
    /// Handed out by the first store that answers.
    pub(crate) epoch: OnceLock<u64>,
}

/// What a link is for.
#[derive(Debug, Clone)]
pub(crate) enum Purpose {
    /// New chunks, until the server was away for so long; none waits for ever.
    Current(Option<Duration>),
    /// What this store was sent before it went away; ends when there is nothing left.
    Leftovers(String),
}

/// Why a link ended.
#[derive(Debug)]
pub(crate) enum LinkEnd {
    /// The server was away for too long.
    Away,
    /// Nothing is left to be sent.
    Empty,
    /// The server refuses this client for good.
    Refused(RpcError),
}

pub(crate) struct AppendLink {
    pub(crate) client: ReplayClient,
    pub(crate) sender: Arc<Sender>,
    pub(crate) spool: Arc<Spool>,
    pub(crate) state: Arc<LinkState>,
    pub(crate) purpose: Purpose,
    /// The store that answered last.
    pub(crate) store_id: Option<String>,
}

impl AppendLink {
    /// Connects again and again until it has a reason to end.
    pub(crate) async fn run(&mut self) -> LinkEnd {
        let mut delays = reconnect_delays();
        let mut working_at = Instant::now();
        loop {
            let mut progressed = false;
            let since = Instant::now();
            let mut connected = false;
            let result = self
                .connection(working_at, &mut connected, &mut progressed)
                .await;
            let status = match result {
                Ok(Some(end)) => return end,
                Ok(None) => Status::unavailable("the server closed the stream"),
                Err(status) => status,
            };
            if is_refusal(&status) {
                return LinkEnd::Refused(self.state.refused(words(&status)));
            }
            self.state.lost(words(&status));
            let lasted = since.elapsed() > RECONNECT_DELAYS.1;
            // A server that answers and at once fails again, whose disk is broken for example, does not work.
            if progressed || (connected && lasted) {
                working_at = Instant::now();
            }
            if progressed || lasted {
                delays = reconnect_delays();
            }
            tokio::time::sleep(delays.next().unwrap_or_default()).await;
        }
    }

    /// One connection; ends early where none comes about soon enough after `working_at`.
    async fn connection(
        &mut self,
        working_at: Instant,
        connected: &mut bool,
        progressed: &mut bool,
    ) -> Result<Option<LinkEnd>, Status> {
        let opening = self.open();
        let opened = match self.purpose {
            Purpose::Current(Some(patience)) => {
                match tokio::time::timeout_at(working_at + patience, opening).await {
                    Ok(opened) => opened?,
                    Err(_) => return Ok(Some(LinkEnd::Away)),
                }
            }
            Purpose::Current(None) | Purpose::Leftovers(_) => opening.await?,
        };
        let Some(opened) = opened else {
            return Ok(None);
        };
        *connected = true;
        self.exchange(opened, progressed).await
    }

    /// Asks who is there and opens a stream to it; none where it closed at once.
    async fn open(&self) -> Result<Option<Opened>, Status> {
        let mut client = self.client.clone();
        let status = client.status(ReplayStatusRequest {}).await?;
        let store_id = status.into_inner().store_id;
        if let Purpose::Leftovers(wanted) = &self.purpose
            && *wanted != store_id
        {
            return Err(Status::unavailable(format!(
                "the store is {store_id} now, {wanted} is away"
            )));
        }
        let acknowledged_seq = self.spool.first_seq(&store_id);
        // A store that knows this process by its own epoch, else what the first one gave it.
        let known = self.spool.epoch(&store_id);
        let epoch = known.or(self.sender.epoch.get().copied()).unwrap_or(0);
        let hello = Hello {
            handshake: Some(self.sender.identity.handshake()),
            actor_id: self.sender.actor_id.clone(),
            epoch,
            acknowledged_seq,
            store_id: store_id.clone(),
            process: self.sender.process,
        };
        let (outbound, requests) = mpsc::channel(IN_FLIGHT_CHUNKS);
        // Room is certain: the queue is new.
        let _ = outbound.try_send(request(Kind::Hello(hello)));
        let mut replies = client
            .append(ReceiverStream::new(requests))
            .await?
            .into_inner();
        let Some(first) = replies.message().await? else {
            return Ok(None);
        };
        Ok(Some(Opened {
            store_id,
            acknowledged_seq,
            outbound,
            replies,
            first,
        }))
    }

    /// Sends and is answered until the connection or the work ends; `progressed` tells whether the server
    /// acknowledged anything new.
    async fn exchange(
        &mut self,
        opened: Opened,
        progressed: &mut bool,
    ) -> Result<Option<LinkEnd>, Status> {
        let Opened {
            store_id,
            acknowledged_seq,
            outbound,
            mut replies,
            first,
        } = opened;
        self.state.connected();
        let _ = self.sender.epoch.set(first.epoch);
        self.spool.begin(&store_id, first.epoch);
        let is_current = matches!(self.purpose, Purpose::Current(_));
        if is_current {
            let given_up = self.spool.turn_to(&store_id);
            if given_up > 0 {
                tracing::warn!(
                    chunks = given_up,
                    "gave up chunks that replay-servers took away with them"
                );
            }
        }
        self.store_id = Some(store_id.clone());
        self.answered(&store_id, &first, acknowledged_seq, progressed)?;
        let mut next_seq = first.durable_seq;
        let mut changes = self.spool.changes();
        loop {
            if !is_current && !self.spool.owes(&store_id) {
                return Ok(Some(LinkEnd::Empty));
            }
            tokio::select! {
                reply = replies.message() => match reply? {
                    Some(reply) => self.answered(&store_id, &reply, acknowledged_seq, progressed)?,
                    None => return Ok(None),
                },
                next = self.next_chunk(&outbound, &mut changes, &store_id, next_seq) => match next {
                    Some((room, chunk)) => {
                        room.send(request(Kind::Chunk(chunk.into())));
                        next_seq += 1;
                    }
                    // The transport dropped the request stream: the replies carry the reason.
                    None => return self.drain(&store_id, &mut replies).await,
                },
            }
        }
    }

    /// Chunk `seq` and room for it in the transport, which comes first: a chunk that is taken belongs to this
    /// store for good. None where the transport is gone.
    async fn next_chunk<'a>(
        &self,
        outbound: &'a mpsc::Sender<AppendRequest>,
        changes: &mut watch::Receiver<()>,
        store_id: &str,
        seq: u64,
    ) -> Option<(mpsc::Permit<'a, AppendRequest>, Chunk)> {
        let take = matches!(self.purpose, Purpose::Current(_));
        let room = outbound.reserve().await.ok()?;
        loop {
            changes.borrow_and_update();
            if let Some(chunk) = self.spool.get(store_id, seq, take) {
                return Some((room, chunk));
            }
            changes.changed().await.ok()?;
        }
    }

    fn answered(
        &self,
        store_id: &str,
        reply: &v1::AppendReply,
        acknowledged_before: u64,
        progressed: &mut bool,
    ) -> Result<(), Status> {
        if reply.durable_seq < acknowledged_before {
            return Err(Status::failed_precondition(format!(
                "the server expects chunk {} though it acknowledged {acknowledged_before}; restart the actor",
                reply.durable_seq
            )));
        }
        *progressed |= reply.durable_seq > acknowledged_before;
        self.spool
            .acknowledge(store_id, reply.durable_seq)
            .map_err(Status::failed_precondition)?;
        self.state.peer_waits(&reply.waiting);
        Ok(())
    }

    async fn drain(
        &self,
        store_id: &str,
        replies: &mut tonic::Streaming<v1::AppendReply>,
    ) -> Result<Option<LinkEnd>, Status> {
        while let Some(reply) = replies.message().await? {
            self.spool
                .acknowledge(store_id, reply.durable_seq)
                .map_err(Status::failed_precondition)?;
        }
        Ok(None)
    }
}

/// A stream whose hello was answered.
struct Opened {
    store_id: String,
    acknowledged_seq: u64,
    outbound: mpsc::Sender<AppendRequest>,
    replies: tonic::Streaming<v1::AppendReply>,
    first: v1::AppendReply,
}

fn request(kind: Kind) -> AppendRequest {
    AppendRequest { kind: Some(kind) }
}
