//! One replay-server of an [`crate::AppendClient`].

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use isodream_core::Chunk;
use isodream_proto::v1::append_request::Kind;
use isodream_proto::v1::{AppendRequest, Hello, ReplayStatusRequest};
use isodream_proto::{Identity, v1};
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

use crate::error::words;
use crate::limits::{RECONNECT_DELAYS, STATUS_TIMEOUT};
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
    /// What this store was sent before the client left it; ends when there is nothing left.
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

/// What came of a connection before it failed.
#[derive(Debug, Default)]
pub(crate) struct Achieved {
    connected: bool,
    /// The server acknowledged something new.
    pub(crate) progressed: bool,
}

pub(crate) struct AppendLink {
    pub(crate) client: ReplayClient,
    pub(crate) sender: Arc<Sender>,
    pub(crate) spool: Arc<Spool>,
    pub(crate) state: Arc<LinkState>,
    pub(crate) purpose: Purpose,
}

impl AppendLink {
    /// Connects again and again until it has a reason to end.
    pub(crate) async fn run(&self) -> LinkEnd {
        let mut delays = reconnect_delays();
        let mut working_at = Instant::now();
        loop {
            let since = Instant::now();
            let mut achieved = Achieved::default();
            let status = match self.connection(working_at, &mut achieved).await {
                Ok(end) => return end,
                Err(status) => status,
            };
            self.state.lost(words(&status));
            let lasted = since.elapsed() > RECONNECT_DELAYS.1;
            // A server that answers and at once fails again, whose disk is broken for example, does not work.
            if achieved.progressed || (achieved.connected && lasted) {
                working_at = Instant::now();
            }
            if achieved.progressed || lasted {
                delays = reconnect_delays();
            }
            tokio::time::sleep(delays.next().unwrap_or_default()).await;
        }
    }

    /// One connection: a reason to end, or why it failed. It ends early where none comes about soon enough after
    /// `working_at`.
    pub(crate) async fn connection(
        &self,
        working_at: Instant,
        achieved: &mut Achieved,
    ) -> Result<LinkEnd, Status> {
        let opened = match self.purpose {
            Purpose::Current(Some(patience)) => {
                match tokio::time::timeout_at(working_at + patience, self.open()).await {
                    Ok(opened) => opened,
                    Err(_) => return Ok(LinkEnd::Away),
                }
            }
            Purpose::Current(None) | Purpose::Leftovers(_) => self.open().await,
        };
        let ended = match opened {
            Ok(opened) => {
                achieved.connected = true;
                self.exchange(opened, &mut achieved.progressed).await
            }
            Err(status) => Err(status),
        };
        match ended {
            Err(status) if is_refusal(&status) => {
                Ok(LinkEnd::Refused(self.state.refused(words(&status))))
            }
            ended => ended,
        }
    }

    /// Asks who is there and opens a stream to it.
    async fn open(&self) -> Result<Opened, Status> {
        let mut client = self.client.clone();
        let store_id = self.store_id(&mut client).await?;
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
        let first = replies.message().await?.ok_or_else(closed)?;
        Ok(Opened {
            store_id,
            acknowledged_seq,
            outbound,
            replies,
            first,
        })
    }

    /// The store that is there; leftovers are for one alone, and a stranger's refusal is none of it.
    async fn store_id(&self, client: &mut ReplayClient) -> Result<String, Status> {
        let asked = client.status(ReplayStatusRequest {});
        let Purpose::Leftovers(wanted) = &self.purpose else {
            return Ok(asked.await?.into_inner().store_id);
        };
        // There are others to be asked. The right one may take its time with all that follows.
        let found = timeout(STATUS_TIMEOUT, asked)
            .await
            .map_err(|_| Status::unavailable("no answer came"))?
            .map_err(|status| Status::unavailable(words(&status)))?;
        let store_id = found.into_inner().store_id;
        if store_id == *wanted {
            return Ok(store_id);
        }
        Err(Status::unavailable(format!(
            "the store there is {store_id}"
        )))
    }

    /// Sends and is answered until the connection or the work ends; `progressed` tells whether the server
    /// acknowledged anything new.
    async fn exchange(&self, opened: Opened, progressed: &mut bool) -> Result<LinkEnd, Status> {
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
        self.answered(&store_id, &first, acknowledged_seq, progressed)?;
        let mut next_seq = first.durable_seq;
        let mut changes = self.spool.changes();
        loop {
            changes.borrow_and_update();
            if !is_current && !self.spool.is_left_behind(&store_id) {
                return Ok(LinkEnd::Empty);
            }
            if self.spool.first_seq(&store_id) > next_seq {
                return Err(Status::unavailable("what comes next is not owed any more"));
            }
            tokio::select! {
                reply = replies.message() => {
                    let reply = reply?.ok_or_else(closed)?;
                    self.answered(&store_id, &reply, acknowledged_seq, progressed)?;
                }
                next = self.next_chunk(&outbound, &store_id, next_seq) => match next {
                    Some((room, chunk)) => {
                        room.send(request(Kind::Chunk(chunk.into())));
                        next_seq += 1;
                    }
                    // The transport dropped the request stream: the replies carry the reason.
                    None => return Err(self.drain(&store_id, &mut replies).await),
                },
                // The spool lives as long as this link.
                _ = changes.changed() => {}
            }
        }
    }

    /// Chunk `seq`, if the spool has it, and room for it in the transport, which comes first: a chunk that is taken
    /// belongs to this store for good. None where the transport is gone.
    async fn next_chunk<'a>(
        &self,
        outbound: &'a mpsc::Sender<AppendRequest>,
        store_id: &str,
        seq: u64,
    ) -> Option<(mpsc::Permit<'a, AppendRequest>, Chunk)> {
        let take = matches!(self.purpose, Purpose::Current(_));
        let room = outbound.reserve().await.ok()?;
        match self.spool.get(store_id, seq, take) {
            Some(chunk) => Some((room, chunk)),
            // The caller asks again at every change.
            None => std::future::pending().await,
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

    /// What is still acknowledged, and why the connection ended.
    async fn drain(
        &self,
        store_id: &str,
        replies: &mut tonic::Streaming<v1::AppendReply>,
    ) -> Status {
        loop {
            let acknowledged = match replies.message().await {
                Ok(Some(reply)) => self.spool.acknowledge(store_id, reply.durable_seq),
                Ok(None) => return closed(),
                Err(status) => return status,
            };
            if let Err(reason) = acknowledged {
                return Status::failed_precondition(reason);
            }
        }
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

fn closed() -> Status {
    Status::unavailable("the server closed the stream")
}

fn request(kind: Kind) -> AppendRequest {
    AppendRequest { kind: Some(kind) }
}
