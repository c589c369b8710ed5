//! The task behind an [`crate::AppendClient`].

use std::sync::Arc;
use std::time::Instant;

use isodream_proto::v1::append_request::Kind;
use isodream_proto::v1::replay_service_client::ReplayServiceClient;
use isodream_proto::v1::{AppendRequest, Hello};
use isodream_proto::{Identity, v1};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use tonic::transport::Channel;

use crate::error::words;
use crate::limits::RECONNECT_DELAYS;
use crate::link_state::LinkState;
use crate::spool::Spool;
use crate::{is_refusal, reconnect_delays};

/// Chunks handed to the transport ahead of its pace.
const IN_FLIGHT_CHUNKS: usize = 4;

pub(crate) struct AppendLink {
    pub(crate) client: ReplayServiceClient<Channel>,
    pub(crate) identity: Identity,
    pub(crate) actor_id: String,
    pub(crate) epoch: u64,
    pub(crate) spool: Arc<Spool>,
    pub(crate) state: Arc<LinkState>,
}

impl AppendLink {
    /// Connects again and again; returns only when the server refuses for good.
    pub(crate) async fn run(&self) {
        let mut delays = reconnect_delays();
        loop {
            let mut progressed = false;
            let since = Instant::now();
            let status = match self.connection(&mut progressed).await {
                Ok(()) => Status::unavailable("the server closed the stream"),
                Err(status) => status,
            };
            if is_refusal(&status) {
                self.state.end(self.state.refused(words(&status)));
                return;
            }
            self.state.lost(words(&status));
            if progressed || since.elapsed() > RECONNECT_DELAYS.1 {
                delays = reconnect_delays();
            }
            tokio::time::sleep(delays.next().unwrap_or_default()).await;
        }
    }

    /// One connection; `progressed` tells whether the server acknowledged anything new.
    async fn connection(&self, progressed: &mut bool) -> Result<(), Status> {
        let (outbound, requests) = mpsc::channel(IN_FLIGHT_CHUNKS);
        let acknowledged_seq = self.spool.acknowledged_seq();
        let hello = Hello {
            handshake: Some(self.identity.handshake()),
            actor_id: self.actor_id.clone(),
            epoch: self.epoch,
            acknowledged_seq,
        };
        // Room is certain: the queue is new.
        let _ = outbound.try_send(request(Kind::Hello(hello)));
        let mut client = self.client.clone();
        let mut replies = client
            .append(ReceiverStream::new(requests))
            .await?
            .into_inner();
        let Some(first) = replies.message().await? else {
            return Ok(());
        };
        self.state.connected();
        self.answered(&first, acknowledged_seq, progressed)?;
        let mut next_seq = first.durable_seq;
        loop {
            let pushed = self.spool.pushed.notified();
            let chunk = self.spool.get(next_seq);
            let has_chunk = chunk.is_some();
            tokio::select! {
                reply = replies.message() => match reply? {
                    Some(reply) => self.answered(&reply, acknowledged_seq, progressed)?,
                    None => return Ok(()),
                },
                room = outbound.reserve(), if has_chunk => match (room, chunk) {
                    (Ok(room), Some(chunk)) => {
                        room.send(request(Kind::Chunk(chunk.into())));
                        next_seq += 1;
                    }
                    // The transport dropped the request stream: the replies carry the reason.
                    _ => return self.drain(&mut replies).await,
                },
                () = pushed, if !has_chunk => {}
            }
        }
    }

    fn answered(
        &self,
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
        self.spool.acknowledge(reply.durable_seq);
        self.state.peer_waits(&reply.waiting);
        Ok(())
    }

    async fn drain(&self, replies: &mut tonic::Streaming<v1::AppendReply>) -> Result<(), Status> {
        while let Some(reply) = replies.message().await? {
            self.spool.acknowledge(reply.durable_seq);
        }
        Ok(())
    }
}

fn request(kind: Kind) -> AppendRequest {
    AppendRequest { kind: Some(kind) }
}
