//! One `Append` stream: chunks in, acknowledgements and reasons to wait out.

use std::sync::Arc;

use isodream_core::Chunk;
use isodream_proto::v1::append_request::Kind;
use isodream_proto::v1::{AppendReply, AppendRequest};
use isodream_rpc::ServiceError;
use isodream_rpc::limits::LINGER;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status, Streaming};
use tracing::Instrument as _;

use crate::commit::{Command, Position, Submission};
use crate::state::{Admission, State, stopping};

/// What a stream's peer has to know; the newest value counts, so nothing queues up behind a slow peer.
#[derive(Debug, Clone, Default)]
struct News {
    durable_seq: u64,
    waiting: String,
    end: Option<ServiceError>,
}

/// The writing end of a stream's news: for its reader and for the commit thread. The stream ends once all
/// copies are gone, so after everything that was handed to the commit thread is answered.
#[derive(Debug)]
pub(crate) struct Progress {
    news: watch::Sender<News>,
    /// Cancelled when the stream is over.
    over: CancellationToken,
}

impl Progress {
    /// Everything below `next_seq` is durable.
    pub(crate) fn durable(&self, next_seq: u64) {
        self.news
            .send_modify(|news| news.durable_seq = news.durable_seq.max(next_seq));
    }

    /// Ends the stream; the first reason stays.
    pub(crate) fn end(&self, error: ServiceError) {
        self.news.send_modify(|news| {
            news.end.get_or_insert(error);
        });
        self.over.cancel();
    }

    /// Tells the peer why its chunks do not move; empty where they do.
    pub(crate) fn waiting(&self, why: String) {
        self.news.send_if_modified(|news| {
            let differs = news.waiting != why;
            news.waiting = why;
            differs
        });
    }
}

/// Serves a stream that begins at `position`.
pub(crate) fn start(
    state: Arc<State>,
    requests: Streaming<AppendRequest>,
    position: Position,
    actor_id: String,
) -> mpsc::Receiver<Result<AppendReply, Status>> {
    let Position { epoch, next_seq } = position;
    let (news, changes) = watch::channel(News {
        durable_seq: next_seq,
        ..News::default()
    });
    let over = CancellationToken::new();
    let (replies, outbound) = mpsc::channel(1);
    let stop = state.stop.clone();
    tokio::spawn(tell(changes, epoch, replies, over.clone(), stop));
    let reader = Reader {
        state,
        progress: Arc::new(Progress { news, over }),
        actor_id,
        epoch,
    };
    tokio::spawn(reader.run(requests));
    outbound
}

/// Sends the newest news until the peer or the stream is gone. A server that stops says so after the last
/// acknowledgement.
async fn tell(
    mut changes: watch::Receiver<News>,
    epoch: u64,
    replies: mpsc::Sender<Result<AppendReply, Status>>,
    over: CancellationToken,
    stop: CancellationToken,
) {
    let _over = over.drop_guard();
    let mut sent = None;
    loop {
        let news = changes.borrow_and_update().clone();
        let reply = AppendReply {
            durable_seq: news.durable_seq,
            waiting: news.waiting,
            epoch,
        };
        if sent.as_ref() != Some(&reply) {
            sent = Some(reply.clone());
            if replies.send(Ok(reply)).await.is_err() {
                return;
            }
        }
        if let Some(error) = news.end {
            let _ = replies.send(Err(error.into())).await;
            return;
        }
        tokio::select! {
            changed = changes.changed() => if changed.is_err() {
                if stop.is_cancelled() {
                    let _ = replies.send(Err(stopping().into())).await;
                }
                return;
            },
            () = replies.closed() => return,
        }
    }
}

/// Whether a request came and is none: too large, or not of this protocol.
pub(crate) fn is_unreadable(status: &Status) -> bool {
    isodream_rpc::is_refusal(status) || status.code() == Code::Internal
}

/// Takes what a peer still sends until it hears of the end: a connection that is closed with unread bytes is
/// reset, and the last acknowledgements and the reason would be lost with it.
async fn discard(mut requests: Streaming<AppendRequest>) {
    let peer_closed = async { while let Ok(Some(_)) = requests.message().await {} };
    let _ = tokio::time::timeout(LINGER, peer_closed).await;
}

struct Reader {
    state: Arc<State>,
    progress: Arc<Progress>,
    actor_id: String,
    epoch: u64,
}

impl Reader {
    async fn run(self, mut requests: Streaming<AppendRequest>) {
        let result = tokio::select! {
            result = self.read(&mut requests) => result,
            () = self.progress.over.cancelled() => return,
            () = self.state.stop.cancelled() => Ok(()),
        };
        // Also where reading ended first, because the commit thread takes nothing any more.
        if self.state.stop.is_cancelled() {
            // What was handed to the commit thread is still stored and acknowledged, and then the stream ends.
            drop(self);
            discard(requests).await;
            return;
        }
        match result {
            Ok(()) => tracing::debug!(actor = %self.actor_id, "append stream closed by its peer"),
            Err(error) => self.progress.end(error),
        }
    }

    async fn read(&self, requests: &mut Streaming<AppendRequest>) -> Result<(), ServiceError> {
        loop {
            let request = match requests.message().await {
                Ok(Some(request)) => request,
                Ok(None) => return Ok(()),
                Err(status) if is_unreadable(&status) => {
                    return Err(ServiceError::Invalid(status.message().to_owned()));
                }
                // The connection is gone; nobody reads an answer.
                Err(_) => return Ok(()),
            };
            let chunk = match request.kind {
                Some(Kind::Chunk(chunk)) => Chunk::try_from(chunk)?,
                Some(Kind::Hello(_)) | None => {
                    return Err(ServiceError::Invalid(
                        "an append stream takes one hello and then chunks".to_owned(),
                    ));
                }
            };
            if chunk.actor_id != self.actor_id || chunk.epoch != self.epoch {
                return Err(ServiceError::Invalid(format!(
                    "chunk {} of `{}` epoch {} came on the stream of `{}` epoch {}",
                    chunk.seq, chunk.actor_id, chunk.epoch, self.actor_id, self.epoch
                )));
            }
            let span = tracing::debug_span!(
                "append",
                actor = self.actor_id,
                seq = chunk.seq,
                steps = chunk.steps
            );
            let waits = tracing::debug_span!(parent: &span, "wait_for_limiter");
            let admission = self.admit(chunk.steps).instrument(waits).await;
            let command = Command::Store(Submission {
                chunk,
                admission,
                progress: self.progress.clone(),
                _span: span,
            });
            self.state.command(command).await?;
        }
    }

    /// Waits for the limiter, and meanwhile reads nothing: that is what holds the peer.
    async fn admit(&self, steps: u32) -> Admission {
        loop {
            let changed = self.state.changed.notified();
            tokio::pin!(changed);
            changed.as_mut().enable();
            match self.state.try_insert(steps) {
                Ok(admission) => {
                    self.progress.waiting(String::new());
                    return admission;
                }
                Err(why) => self.progress.waiting(why),
            }
            changed.await;
        }
    }
}
