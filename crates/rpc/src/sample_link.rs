//! One replay-server of a [`crate::SampleClient`]: it connects, and reports to the client's task.

use std::sync::Arc;

use isodream_proto::v1::{ReplayStatus, ReplayStatusRequest, SampleReply, SampleRequest};
use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

use crate::error::words;
use crate::limits::{RECONNECT_DELAYS, STATUS_INTERVAL, STATUS_TIMEOUT};
use crate::link_state::LinkState;
use crate::{ReplayClient, RpcError, is_refusal, reconnect_delays};

/// What a link reports, in the order in which it happened.
pub(crate) enum Event {
    /// A server is there. The client's task queues hello and credits on `requests`, and answers whether the
    /// stream shall be opened.
    Found {
        status: ReplayStatus,
        requests: mpsc::Sender<SampleRequest>,
        answer: oneshot::Sender<bool>,
    },
    /// A sequence, or a reason to wait.
    Reply(SampleReply),
    /// What the server holds now.
    Holds(ReplayStatus),
    /// The connection is gone, and its credits with it.
    Lost,
    /// The server refuses this client for good.
    Refused(RpcError),
}

pub(crate) struct SampleLink {
    pub(crate) address: String,
    pub(crate) client: ReplayClient,
    pub(crate) state: Arc<LinkState>,
    /// Requests queued on one connection at most.
    pub(crate) requests_ahead: usize,
    pub(crate) events: mpsc::Sender<(String, Event)>,
}

impl SampleLink {
    /// Connects again and again; returns when the server refuses for good or nobody listens any more.
    pub(crate) async fn run(self) {
        let mut delays = reconnect_delays();
        loop {
            let mut progressed = false;
            let since = Instant::now();
            let status = match self.connection(&mut progressed).await {
                Ok(()) => Status::unavailable("the server closed the stream"),
                Err(status) => status,
            };
            let refused = is_refusal(&status);
            self.state.lost(words(&status));
            let event = if refused {
                Event::Refused(self.state.refused(words(&status)))
            } else {
                Event::Lost
            };
            if !self.report(event).await || refused {
                return;
            }
            if progressed || since.elapsed() > RECONNECT_DELAYS.1 {
                delays = reconnect_delays();
            }
            tokio::time::sleep(delays.next().unwrap_or_default()).await;
        }
    }

    /// One connection; `progressed` tells whether a sequence came.
    async fn connection(&self, progressed: &mut bool) -> Result<(), Status> {
        let mut client = self.client.clone();
        let status = client.status(ReplayStatusRequest {}).await?.into_inner();
        let (requests, outbound) = mpsc::channel(self.requests_ahead);
        let (answer, wanted) = oneshot::channel();
        let found = Event::Found {
            status: status.clone(),
            requests,
            answer,
        };
        if !self.report(found).await {
            return Ok(());
        }
        if !wanted.await.unwrap_or(false) {
            return Err(Status::unavailable(
                "its store is served at another address as well",
            ));
        }
        let mut replies = client
            .sample(ReceiverStream::new(outbound))
            .await?
            .into_inner();
        self.state.connected();
        // Only now: what a server holds that refuses this client is none of its.
        if !self.report(Event::Holds(status)).await {
            return Ok(());
        }
        tokio::select! {
            result = self.receive(&mut replies, progressed) => result,
            () = self.watch_holdings() => Ok(()),
        }
    }

    async fn receive(
        &self,
        replies: &mut Streaming<SampleReply>,
        progressed: &mut bool,
    ) -> Result<(), Status> {
        while let Some(reply) = replies.message().await? {
            *progressed |= !reply.chunks.is_empty();
            self.state.peer_waits(&reply.waiting);
            if !self.report(Event::Reply(reply)).await {
                break;
            }
        }
        Ok(())
    }

    /// Returns where nobody listens any more. A missing answer is no reason to give the stream up: keepalive
    /// watches over it.
    async fn watch_holdings(&self) {
        let mut client = self.client.clone();
        loop {
            tokio::time::sleep(STATUS_INTERVAL).await;
            let answer = timeout(STATUS_TIMEOUT, client.status(ReplayStatusRequest {})).await;
            if let Ok(Ok(status)) = answer
                && !self.report(Event::Holds(status.into_inner())).await
            {
                return;
            }
        }
    }

    /// False where nobody listens any more.
    async fn report(&self, event: Event) -> bool {
        self.events
            .send((self.address.clone(), event))
            .await
            .is_ok()
    }
}
