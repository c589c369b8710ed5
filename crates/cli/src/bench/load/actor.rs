//! An actor without an environment: it appends recorded chunks at its pace and follows the policy.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use isodream_core::{Chunk, EpisodeId, derive_seed};
use isodream_proto::{Identity, v1};
use isodream_rpc::limits::FAILOVER_AFTER;
use isodream_rpc::{
    AcknowledgedChunks, AppendClient, AppendOptions, LearnerClient, PolicySink, follow_policy,
};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::board::Board;

/// How long what was sent may take to become durable at the end.
const FLUSH_DEADLINE: Duration = Duration::from_secs(30);

/// A chunk, encoded once for all actors.
#[derive(Debug, Clone)]
pub(super) struct Recorded {
    pub(super) first_step: u32,
    pub(super) steps: u32,
    pub(super) ends_episode: bool,
    pub(super) payload: Bytes,
}

/// What all actors have in common.
pub(super) struct Crowd {
    pub(super) actors: u64,
    pub(super) identity: Identity,
    /// Drawn at the start; names the episodes.
    pub(super) entropy: u64,
    pub(super) replay: Vec<String>,
    pub(super) episodes: Vec<Vec<Recorded>>,
    /// Of one actor; none appends as fast as chunks become durable.
    pub(super) steps_per_second: Option<f64>,
    pub(super) spool_chunks: usize,
    pub(super) spool_bytes: usize,
    pub(super) board: Arc<Board>,
    pub(super) stop: CancellationToken,
}

impl Crowd {
    /// Connects actor `index` and lets it work until the crowd stops. Its policies and reports go through `learner`.
    ///
    /// # Errors
    /// Where a server refuses it, or chunks do not become durable at the end.
    pub(super) async fn act(
        self: Arc<Self>,
        index: u64,
        append: AppendClient,
        learner: LearnerClient,
    ) -> anyhow::Result<()> {
        let name = self.name(index);
        let acknowledgements = Arc::new(Acknowledgements {
            board: self.board.clone(),
            due: Mutex::default(),
            any: AtomicBool::new(false),
        });
        append.observe(acknowledgements.clone());
        let request = v1::WatchPolicyRequest {
            handshake: Some(self.identity.handshake()),
            actor_id: name.clone(),
        };
        let follower = Follower {
            board: self.board.clone(),
            informed: false,
        };
        tokio::select! {
            refusal = follow_policy(learner.clone(), request, follower) => {
                anyhow::bail!("the learner refused {name}: {}", refusal.message())
            }
            sent = self.send(index, &name, &append, &learner, &acknowledgements) => sent?,
            () = self.stop.cancelled() => {}
        }
        append.close();
        Ok(append.flush(FLUSH_DEADLINE).await?)
    }

    pub(super) fn appending(&self, index: u64) -> AppendOptions {
        AppendOptions {
            addresses: self.replay.clone(),
            identity: self.identity.clone(),
            actor_id: self.name(index),
            spool_chunks: self.spool_chunks,
            spool_bytes: self.spool_bytes,
            failover_after: FAILOVER_AFTER,
        }
    }

    fn name(&self, index: u64) -> String {
        format!("load-{index}")
    }

    /// Appends episode after episode, and reports each.
    async fn send(
        &self,
        index: u64,
        name: &str,
        append: &AppendClient,
        learner: &LearnerClient,
        acknowledgements: &Acknowledgements,
    ) -> anyhow::Result<()> {
        let begun = Instant::now();
        // Actors of a real run are not in step with each other either.
        let share = index as f64 / self.actors as f64;
        let mut due = share * self.seconds_of(&self.episodes[0][0]);
        let mut reports = tokio::task::JoinSet::new();
        for number in 0_u64.. {
            let episode_id = derive_seed(self.entropy, &["episode", name, &number.to_string()]);
            let recording = (index + number) as usize % self.episodes.len();
            for recorded in &self.episodes[recording] {
                // A chunk that cannot be sent in time is late from when it was due: waiting counts.
                let at = match self.steps_per_second {
                    Some(_) => begun + Duration::from_secs_f64(due),
                    None => Instant::now(),
                };
                due += self.seconds_of(recorded);
                tokio::time::sleep_until(at).await;
                acknowledgements.expect(episode_id, recorded.first_step, at);
                append.send(recorded.chunk(episode_id)).await?;
            }
            let report = self.report(name, episode_id, recording);
            let (mut learner, board) = (learner.clone(), self.board.clone());
            reports.spawn(async move {
                let counter = match learner.report_episode(report).await {
                    Ok(_) => &board.reports,
                    Err(_) => &board.lost_reports,
                };
                board.count(counter, 1);
            });
            while reports.try_join_next().is_some() {}
        }
        Ok(())
    }

    /// How long an actor takes for a chunk.
    fn seconds_of(&self, recorded: &Recorded) -> f64 {
        self.steps_per_second
            .map_or(0.0, |pace| f64::from(recorded.steps) / pace)
    }

    fn report(&self, name: &str, episode_id: EpisodeId, recording: usize) -> v1::EpisodeReport {
        let steps: u32 = self.episodes[recording].iter().map(|part| part.steps).sum();
        v1::EpisodeReport {
            actor_id: name.to_owned(),
            role: v1::ActorRole::Collect.into(),
            episode_id,
            length: steps,
            end_reason: "time_limit".to_owned(),
            ..v1::EpisodeReport::default()
        }
    }
}

impl Recorded {
    fn chunk(&self, episode_id: EpisodeId) -> Chunk {
        Chunk {
            // The append client fills in who sends and the number.
            actor_id: String::new(),
            epoch: 0,
            seq: 0,
            episode_id,
            first_step: self.first_step,
            steps: self.steps,
            ends_episode: self.ends_episode,
            payload: self.payload.clone(),
        }
    }
}

/// When the chunks that are not durable yet were due.
#[derive(Debug)]
struct Acknowledgements {
    board: Arc<Board>,
    due: Mutex<HashMap<(EpisodeId, u32), Instant>>,
    /// Whether there was one.
    any: AtomicBool,
}

impl Acknowledgements {
    fn expect(&self, episode_id: EpisodeId, first_step: u32, due: Instant) {
        let mut all = self.due.lock().unwrap_or_else(PoisonError::into_inner);
        all.insert((episode_id, first_step), due);
    }
}

impl AcknowledgedChunks for Acknowledgements {
    fn acknowledged(&self, _store_id: &str, chunk: &Chunk) {
        if !self.any.swap(true, Ordering::Relaxed) {
            self.board.inserting.fetch_add(1, Ordering::Relaxed);
        }
        let key = (chunk.episode_id, chunk.first_step);
        let mut all = self.due.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(due) = all.remove(&key) {
            self.board
                .appended(chunk.steps, chunk.payload.len(), due.elapsed());
        }
    }
}

/// Verifies policies and lets go of them: a thousand copies would not fit this process.
struct Follower {
    board: Arc<Board>,
    informed: bool,
}

impl PolicySink for Follower {
    fn begin(&mut self, announcement: &v1::PolicyAnnouncement) {
        if let Some(version) = announcement.version {
            self.board.published(version);
        }
    }

    fn part(&mut self, part: Bytes) {
        self.board
            .count(&self.board.policy_bytes, part.len() as u64);
    }

    fn complete(&mut self, version: v1::PolicyVersion) {
        self.board.verified(version);
        if !std::mem::replace(&mut self.informed, true) {
            self.board.informed.fetch_add(1, Ordering::Relaxed);
        }
    }
}
