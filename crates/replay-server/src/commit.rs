//! The thread that owns the log: whatever has arrived is written, synced once and acknowledged.

use std::sync::Arc;

use isodream_core::Chunk;
use isodream_replay::{Outcome, ReplayError, StoreIdentity, StoreWriter};
use isodream_rpc::ServiceError;
use tokio::sync::{mpsc, oneshot};

use crate::append::Progress;
use crate::errors::service_error;
use crate::state::{Admission, State, stopping};

/// Payload bytes after which a group is closed: about 100 ms of a slow disk.
const GROUP_BYTES: usize = 16 << 20;

/// What streams ask of the commit thread.
pub(crate) enum Command {
    /// Tell what the store belongs to; an offered identity becomes the store's where it has none.
    Identity {
        offered: StoreIdentity,
        answer: oneshot::Sender<Result<StoreIdentity, ServiceError>>,
    },
    /// An actor connects; the answer is the sequence number it has to send next.
    Begin {
        actor_id: String,
        epoch: u64,
        acknowledged_seq: u64,
        answer: oneshot::Sender<Result<u64, ServiceError>>,
    },
    /// Store a chunk and tell its stream.
    Store(Submission),
}

/// A chunk that the limiter admitted, and whom to tell what became of it.
pub(crate) struct Submission {
    pub(crate) chunk: Chunk,
    pub(crate) admission: Admission,
    pub(crate) progress: Arc<Progress>,
}

pub(crate) struct Committer {
    pub(crate) writer: StoreWriter,
    pub(crate) queue: mpsc::Receiver<Command>,
    pub(crate) state: Arc<State>,
}

impl Committer {
    /// Starts the thread. It ends when the server stops, or with the error that ended the log.
    pub(crate) fn spawn(mut self) -> std::io::Result<oneshot::Receiver<Result<(), ReplayError>>> {
        let (ended, receiver) = oneshot::channel();
        let runtime = tokio::runtime::Handle::current();
        std::thread::Builder::new()
            .name("replay-commit".to_owned())
            .spawn(move || {
                let result = self.run(&runtime);
                // The folder is free before anybody hears of the end.
                drop(self);
                let _ = ended.send(result);
            })?;
        Ok(receiver)
    }

    fn run(&mut self, runtime: &tokio::runtime::Handle) -> Result<(), ReplayError> {
        let stop = self.state.stop.clone();
        loop {
            let first = runtime.block_on(async {
                tokio::select! {
                    biased;
                    command = self.queue.recv() => command,
                    () = stop.cancelled() => None,
                }
            });
            let Some(first) = first else { return Ok(()) };
            self.serve_arrived(first)?;
        }
    }

    /// Serves `first` and everything that has arrived since, in order, chunks in groups.
    fn serve_arrived(&mut self, first: Command) -> Result<(), ReplayError> {
        let mut group = Vec::new();
        let mut group_bytes = 0;
        let mut next = Some(first);
        while let Some(command) = next {
            match command {
                Command::Store(submission) => {
                    group_bytes += submission.chunk.payload.len();
                    group.push(submission);
                    if group_bytes >= GROUP_BYTES {
                        break;
                    }
                }
                Command::Begin {
                    actor_id,
                    epoch,
                    acknowledged_seq,
                    answer,
                } => {
                    self.commit(std::mem::take(&mut group))?;
                    group_bytes = 0;
                    let begun = self.writer.begin(&actor_id, epoch, acknowledged_seq);
                    reply(answer, begun)?;
                }
                Command::Identity { offered, answer } => {
                    let adopted = self.writer.adopt_identity(&offered);
                    reply(answer, adopted)?;
                }
            }
            next = self.queue.try_recv().ok();
        }
        self.commit(group)
    }

    fn commit(&mut self, group: Vec<Submission>) -> Result<(), ReplayError> {
        if group.is_empty() {
            return Ok(());
        }
        let (chunks, streams): (Vec<_>, Vec<_>) = group
            .into_iter()
            .map(|submission| {
                (
                    submission.chunk,
                    (submission.admission, submission.progress),
                )
            })
            .unzip();
        let result = match self.writer.commit(chunks) {
            Ok(outcomes) => {
                for (outcome, (admission, stream)) in outcomes.into_iter().zip(streams) {
                    tell(outcome, admission, &stream);
                }
                Ok(())
            }
            Err(error) => {
                tracing::error!(%error, chunks = streams.len(), "cannot store chunks");
                for (_, stream) in streams {
                    stream.end(service_error(&error));
                }
                if error.is_fatal() { Err(error) } else { Ok(()) }
            }
        };
        self.state.changed.notify_waiters();
        result
    }
}

fn tell(outcome: Outcome, admission: Admission, stream: &Progress) {
    match outcome {
        Outcome::Stored { next_seq } => {
            admission.stored();
            stream.durable(next_seq);
        }
        Outcome::Duplicate { next_seq } => stream.durable(next_seq),
        Outcome::Gap { expected_seq } => {
            stream.durable(expected_seq);
            stream.end(ServiceError::OutOfOrder(format!(
                "chunk {expected_seq} has to come first; reconnect and send from there"
            )));
        }
        Outcome::Fenced { newer_epoch } => stream.end(ServiceError::Refused(format!(
            "this actor is fenced off: a newer process with its id (epoch {newer_epoch}) is connected, stop one of them"
        ))),
        Outcome::Invalid { reason } => stream.end(ServiceError::Invalid(reason)),
    }
}

/// Answers a stream that may have gone; a fatal error ends the thread as well.
fn reply<T>(
    answer: oneshot::Sender<Result<T, ServiceError>>,
    result: Result<T, ReplayError>,
) -> Result<(), ReplayError> {
    match result {
        Ok(value) => {
            let _ = answer.send(Ok(value));
            Ok(())
        }
        Err(error) => {
            let _ = answer.send(Err(service_error(&error)));
            if error.is_fatal() { Err(error) } else { Ok(()) }
        }
    }
}

/// The commit thread's answer; a thread that is gone means that the server stops.
pub(crate) async fn answered<T>(
    answer: oneshot::Receiver<Result<T, ServiceError>>,
) -> Result<T, ServiceError> {
    answer.await.unwrap_or_else(|_| Err(stopping()))
}
