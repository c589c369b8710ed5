//! The thread that owns the log: whatever has arrived is written, synced once and acknowledged.
//!
//! While the disk is full, what was admitted stays here and is tried again, and nothing more is admitted.

use std::sync::Arc;
use std::time::{Duration, Instant};

use isodream_core::Chunk;
use isodream_proto::v1::Hello;
use isodream_replay::{Outcome, ReplayError, StoreIdentity, StoreWriter};
use isodream_rpc::ServiceError;
use tokio::sync::{mpsc, oneshot};

use crate::append::Progress;
use crate::errors::service_error;
use crate::metrics;
use crate::state::{Admission, State, stopping};

/// Payload bytes after which a group is closed: about 100 ms of a slow disk.
const GROUP_BYTES: usize = 16 << 20;

/// Pause before a full disk is tried again.
const FULL_DISK_PAUSE: Duration = Duration::from_millis(500);

/// What streams ask of the commit thread.
pub(crate) enum Command {
    /// Tell what the store belongs to; an offered identity becomes the store's where it has none.
    Identity {
        offered: StoreIdentity,
        answer: oneshot::Sender<Result<StoreIdentity, ServiceError>>,
    },
    /// An actor connects.
    Begin {
        hello: Hello,
        answer: oneshot::Sender<Result<Position, ServiceError>>,
    },
    /// Store a chunk and tell its stream.
    Store(Submission),
}

/// Where an actor's stream begins.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Position {
    pub(crate) epoch: u64,
    /// The sequence number that it has to send next.
    pub(crate) next_seq: u64,
}

/// A chunk that the limiter admitted, and whom to tell what became of it.
pub(crate) struct Submission {
    pub(crate) chunk: Chunk,
    pub(crate) admission: Admission,
    pub(crate) progress: Arc<Progress>,
    /// Ends when the stream was told.
    pub(crate) _span: tracing::Span,
}

pub(crate) struct Committer {
    writer: StoreWriter,
    queue: mpsc::Receiver<Command>,
    state: Arc<State>,
    /// Admitted chunks in order; more than one group only while the disk is full.
    pending: Vec<Submission>,
    pending_bytes: usize,
    /// When a full disk is tried again.
    retry_at: Option<Instant>,
}

impl Committer {
    pub(crate) fn new(
        writer: StoreWriter,
        queue: mpsc::Receiver<Command>,
        state: Arc<State>,
    ) -> Self {
        Self {
            writer,
            queue,
            state,
            pending: Vec::new(),
            pending_bytes: 0,
            retry_at: None,
        }
    }

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
        while !stop.is_cancelled() {
            let retry_at = self.retry_at;
            let first = runtime.block_on(async {
                tokio::select! {
                    () = stop.cancelled() => None,
                    command = self.queue.recv() => command,
                    () = pause_until(retry_at) => None,
                }
            });
            match first {
                Some(first) => self.serve_arrived(first)?,
                None => self.commit()?,
            }
        }
        // What arrived in time is stored and acknowledged.
        self.queue.close();
        while let Some(command) = self.queue.blocking_recv() {
            self.serve_arrived(command)?;
        }
        Ok(())
    }

    /// Serves `first` and everything that has arrived since, in order, chunks in groups.
    fn serve_arrived(&mut self, first: Command) -> Result<(), ReplayError> {
        let mut next = Some(first);
        while let Some(command) = next {
            match command {
                Command::Store(submission) => {
                    self.pending_bytes += submission.chunk.payload.len();
                    self.pending.push(submission);
                    if self.pending_bytes >= GROUP_BYTES {
                        break;
                    }
                }
                Command::Begin { hello, answer } => {
                    self.commit()?;
                    reply(answer, self.begin(&hello))?;
                }
                Command::Identity { offered, answer } => {
                    let adopted = self.writer.adopt_identity(&offered);
                    reply(answer, adopted)?;
                }
            }
            next = self.queue.try_recv().ok();
        }
        self.commit()
    }

    fn begin(&mut self, hello: &Hello) -> Result<Position, ReplayError> {
        let epoch = self
            .writer
            .epoch_for(&hello.actor_id, hello.process, hello.epoch)?;
        let next_seq = self
            .writer
            .begin(&hello.actor_id, epoch, hello.acknowledged_seq)?;
        Ok(Position { epoch, next_seq })
    }

    /// Stores what is pending, unless the disk is full and its pause is not over.
    fn commit(&mut self) -> Result<(), ReplayError> {
        if self.pending.is_empty() || self.retry_at.is_some_and(|at| Instant::now() < at) {
            return Ok(());
        }
        let _commit = tracing::debug_span!(
            "commit",
            chunks = self.pending.len(),
            bytes = self.pending_bytes
        )
        .entered();
        // Payloads are shared, not copied.
        let chunks = self.pending.iter().map(|held| held.chunk.clone()).collect();
        let begun = Instant::now();
        let result = match self.writer.commit(chunks) {
            Err(error @ ReplayError::Full { .. }) => {
                self.wait_for_room(&error);
                return Ok(());
            }
            result => result,
        };
        if self.retry_at.take().is_some() {
            tracing::info!("there is room on the replay disk again, inserts go on");
            for held in &self.pending {
                held.progress.waiting(String::new());
            }
            self.state.set_stall(None);
        }
        let bytes = std::mem::take(&mut self.pending_bytes);
        let pending = std::mem::take(&mut self.pending);
        let result = match result {
            Ok(outcomes) => {
                metrics::committed(pending.len(), bytes, begun.elapsed());
                for (outcome, held) in outcomes.into_iter().zip(pending) {
                    tell(outcome, held.admission, &held.progress);
                }
                Ok(())
            }
            Err(error) => {
                tracing::error!(%error, chunks = pending.len(), "cannot store chunks");
                for held in pending {
                    held.progress.end(service_error(&error));
                }
                if error.is_fatal() { Err(error) } else { Ok(()) }
            }
        };
        self.state.changed.notify_waiters();
        result
    }

    /// Keeps what is pending, tells everyone why, and has it tried again later.
    fn wait_for_room(&mut self, error: &ReplayError) {
        if self.retry_at.is_none() {
            tracing::warn!(%error, "inserts wait for room on the replay disk, sampling goes on");
            self.state.set_stall(Some(error.to_string()));
        }
        self.retry_at = Some(Instant::now() + FULL_DISK_PAUSE);
        for held in &self.pending {
            held.progress.waiting(error.to_string());
        }
    }
}

/// Never comes where no time is given.
async fn pause_until(at: Option<Instant>) {
    match at {
        Some(at) => tokio::time::sleep_until(at.into()).await,
        None => std::future::pending().await,
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
