//! One `Sample` stream: credits and priorities in, sequences and reasons to wait out.

use std::collections::VecDeque;
use std::sync::Arc;

use isodream_core::Chunk;
use isodream_proto::v1::sample_request::Kind;
use isodream_proto::v1::{PriorityUpdates, SampleCredit, SampleReply, SampleRequest};
use isodream_replay::{ChunkRef, Draw, PriorityUpdate, ReplayError, Sampler, SequenceRef};
use isodream_rpc::ServiceError;
use tokio::sync::mpsc;
use tonic::{Status, Streaming};

use crate::append::is_unreadable;
use crate::errors::service_error;
use crate::state::{Reign, State, stopping};

/// Sequences read by one blocking task.
const READ_GROUP: usize = 8;
/// Sequences that a peer may have asked for and not received.
const MAX_CREDITS: u32 = 1 << 16;
/// Replies handed to the transport ahead of its pace.
const REPLIES_AHEAD: usize = 4;

/// Priorities set before other streams get their turn: tenths of a millisecond.
const PRIORITY_GROUP: usize = 256;

/// What a stream draws with.
pub(crate) struct Drawer {
    pub(crate) sampler: Sampler,
    /// Whether the draws count against the rate limiter.
    pub(crate) limited: bool,
}

type Replies = mpsc::Sender<Result<SampleReply, Status>>;

/// Serves a stream whose hello was accepted, until a newer learner comes.
pub(crate) fn start(
    state: Arc<State>,
    requests: Streaming<SampleRequest>,
    drawer: Drawer,
    reign: Reign,
    waiting_credits: u32,
) -> mpsc::Receiver<Result<SampleReply, Status>> {
    let (replies, outbound) = mpsc::channel(REPLIES_AHEAD);
    let stop = state.stop.clone();
    let mut stream = SampleStream {
        state,
        drawer,
        credits: VecDeque::new(),
        waiting_credits: match waiting_credits {
            0 => u32::MAX,
            count => count,
        },
        replies,
        announced: String::new(),
    };
    tokio::spawn(async move {
        let replies = stream.replies.clone();
        let result = tokio::select! {
            result = stream.run(requests) => result,
            () = stop.cancelled() => Err(stopping()),
            fenced = reign.end() => Err(fenced),
            () = replies.closed() => Ok(()),
        };
        if let Err(error) = result {
            let _ = replies.send(Err(error.into())).await;
        }
    });
    outbound
}

struct SampleStream {
    state: Arc<State>,
    drawer: Drawer,
    /// What the peer asked for, in its order.
    credits: VecDeque<(Draw, u32)>,
    /// More credits than these are given back rather than kept waiting.
    waiting_credits: u32,
    replies: Replies,
    /// The reason to wait that the peer knows.
    announced: String,
}

impl SampleStream {
    async fn run(&mut self, mut requests: Streaming<SampleRequest>) -> Result<(), ServiceError> {
        let state = self.state.clone();
        loop {
            let changed = state.changed.notified();
            tokio::pin!(changed);
            changed.as_mut().enable();
            let draws = self.draw();
            if !draws.is_empty() {
                self.send(draws).await?;
                continue;
            }
            self.announce().await?;
            tokio::select! {
                request = requests.message() => match request {
                    Ok(Some(request)) => self.request(request).await?,
                    Err(status) if is_unreadable(&status) => {
                        return Err(ServiceError::Invalid(status.message().to_owned()));
                    }
                    Ok(None) | Err(_) => return Ok(()),
                },
                () = changed => {}
            }
        }
    }

    async fn request(&mut self, request: SampleRequest) -> Result<(), ServiceError> {
        match request.kind {
            Some(Kind::Credit(credit)) => self.credit(credit),
            Some(Kind::Priorities(updates)) => self.set_priorities(&updates).await,
            Some(Kind::Hello(_)) | None => Err(ServiceError::Invalid(
                "a sample stream takes one hello and then credits and priorities".to_owned(),
            )),
        }
    }

    fn credit(&mut self, credit: SampleCredit) -> Result<(), ServiceError> {
        let granted = self.credits.iter().map(|(_, count)| *count).sum::<u32>();
        if credit.sequences == 0 || credit.sequences > MAX_CREDITS - granted {
            return Err(ServiceError::Invalid(format!(
                "a credit of {} sequences beside {granted} granted ones; grant 1 to {MAX_CREDITS} in all",
                credit.sequences
            )));
        }
        let draw = if credit.unlimited || !self.drawer.limited {
            Draw::Unlimited
        } else {
            Draw::Limited
        };
        match self.credits.back_mut() {
            Some((last, count)) if *last == draw => *count += credit.sequences,
            _ => self.credits.push_back((draw, credit.sequences)),
        }
        Ok(())
    }

    async fn set_priorities(&self, updates: &PriorityUpdates) -> Result<(), ServiceError> {
        let (episodes, starts) = (&updates.episode_ids, &updates.start_steps);
        let count = updates.priorities.len();
        if episodes.len() != count || starts.len() != count {
            return Err(ServiceError::Invalid(format!(
                "{count} priorities came with {} episodes and {} start steps",
                episodes.len(),
                starts.len()
            )));
        }
        let updates: Vec<_> = episodes
            .iter()
            .zip(starts)
            .zip(&updates.priorities)
            .map(|((episode_id, start_step), priority)| PriorityUpdate {
                episode_id: *episode_id,
                start_step: *start_step,
                priority: *priority,
            })
            .collect();
        for group in updates.chunks(PRIORITY_GROUP) {
            self.drawer
                .sampler
                .update_priorities(group)
                .map_err(|error| service_error(&error))?;
            tokio::task::yield_now().await;
        }
        Ok(())
    }

    /// As many sequences as credits and limiter allow, up to one group.
    fn draw(&mut self) -> Vec<(Draw, SequenceRef)> {
        let mut draws = Vec::new();
        while draws.len() < READ_GROUP {
            let Some((draw, count)) = self.credits.front_mut() else {
                break;
            };
            if *count == 0 {
                self.credits.pop_front();
                continue;
            }
            let Ok(sequence) = self.state.try_draw(*draw, &mut self.drawer.sampler) else {
                break;
            };
            *count -= 1;
            draws.push((*draw, sequence));
        }
        draws
    }

    /// Reads and sends; what cannot be read goes out of the store and its credit back.
    async fn send(&mut self, draws: Vec<(Draw, SequenceRef)>) -> Result<(), ServiceError> {
        self.announced.clear();
        let span = tracing::debug_span!("read_sequences", sequences = draws.len());
        let read = tokio::task::spawn_blocking(move || {
            let _read = span.entered();
            draws
                .into_iter()
                .map(|(draw, sequence)| {
                    let chunks = read(&sequence);
                    (draw, sequence, chunks)
                })
                .collect::<Vec<_>>()
        })
        .await
        .map_err(|error| ServiceError::Internal(format!("reading a sequence failed: {error}")))?;
        for (draw, sequence, chunks) in read {
            match chunks {
                Ok(chunks) => {
                    let reply = SampleReply {
                        chunks: chunks.into_iter().map(Into::into).collect(),
                        offset: sequence.offset,
                        episode_id: sequence.episode_id,
                        start_step: sequence.start_step,
                        probability: sequence.probability,
                        ..SampleReply::default()
                    };
                    self.reply(reply).await?;
                }
                Err((chunk, error)) => {
                    let dropped = self.drop_unreadable(&chunk, &error);
                    // After the store has changed, because this wakes those who wait for it.
                    self.state
                        .undo_draw(draw, self.drawer.sampler.sequence_length());
                    dropped?;
                    self.credits.push_front((draw, 1));
                }
            }
        }
        Ok(())
    }

    fn drop_unreadable(&self, chunk: &ChunkRef, error: &ReplayError) -> Result<(), ServiceError> {
        let ReplayError::Damaged { reason, .. } = error else {
            // The disk may recover; the data is not known to be lost.
            return Err(ServiceError::Unavailable(error.to_string()));
        };
        tracing::warn!(%error, "took a damaged replay record out of service");
        self.state.store.quarantine(chunk, reason);
        Ok(())
    }

    /// Tells the peer why it waits, once per reason, and gives back the credits that shall not.
    async fn announce(&mut self) -> Result<(), ServiceError> {
        let Some((draw, _)) = self.credits.front().copied() else {
            return Ok(());
        };
        let Some(waiting) = self.state.why_draw_waits(draw, &self.drawer.sampler) else {
            return Ok(());
        };
        let returned_credits = self.give_back();
        if waiting == self.announced && returned_credits == 0 {
            return Ok(());
        }
        self.announced.clone_from(&waiting);
        self.reply(SampleReply {
            waiting,
            returned_credits,
            ..SampleReply::default()
        })
        .await
    }

    /// Drops the newest credits beyond those that may wait, and counts them.
    fn give_back(&mut self) -> u32 {
        let mut room = self.waiting_credits;
        let mut returned = 0;
        for (_, count) in &mut self.credits {
            let kept = room.min(*count);
            room -= kept;
            returned += *count - kept;
            *count = kept;
        }
        self.credits.retain(|(_, count)| *count > 0);
        returned
    }

    async fn reply(&self, reply: SampleReply) -> Result<(), ServiceError> {
        self.replies.send(Ok(reply)).await.map_err(|_| stopping())
    }
}

/// All chunks of a sequence, or the one that cannot be read.
fn read(sequence: &SequenceRef) -> Result<Vec<Chunk>, (ChunkRef, ReplayError)> {
    sequence
        .chunks
        .iter()
        .map(|chunk| chunk.read().map_err(|error| (chunk.clone(), error)))
        .collect()
}
