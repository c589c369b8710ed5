//! What the roles of a live run say of themselves.

use std::time::Duration;

use isodream_proto::v1;
use isodream_rpc::Dialer;
use serde::Serialize;

/// How long a role may take to answer.
const ANSWER_DEADLINE: Duration = Duration::from_millis(800);

/// The roles of a live run.
#[derive(Debug, Clone)]
pub struct Sources {
    /// How they are reached, as a viewer.
    pub dialer: Dialer,
    /// The learner, `host:port`.
    pub learner: String,
    /// The replay-servers, `host:port`.
    pub replay: Vec<String>,
}

/// What `/api/live` answers. A role that does not answer in time is absent.
#[derive(Debug, Default, Serialize)]
pub struct Live {
    /// The learner.
    pub learner: Option<LearnerView>,
    /// The replay-servers, each with its address.
    pub replay: Vec<ReplayView>,
}

/// The learner's words.
#[derive(Debug, Serialize)]
pub struct LearnerView {
    /// What it is doing.
    pub phase: String,
    /// Updates made.
    pub updates: u64,
    /// Updates after which it ends.
    pub total_updates: u64,
    /// Updates per second.
    pub updates_per_s: f64,
    /// Environment frames, action repeat counted.
    pub env_frames: u64,
    /// Environment frames per second.
    pub env_frames_per_s: f64,
    /// Share of time spent waiting for data, in `[0, 1]`.
    pub wait_share: f64,
    /// Mean return of the newest collecting episodes; none before the first.
    pub collect_score: Option<f64>,
    /// Mean return of the newest evaluation; none before the first.
    pub evaluate_score: Option<f64>,
    /// Everybody who reports episodes.
    pub actors: Vec<ActorView>,
}

/// An actor, as the learner knows it.
#[derive(Debug, Serialize)]
pub struct ActorView {
    /// Its name.
    pub id: String,
    /// Whether it evaluates instead of collecting.
    pub evaluates: bool,
    /// Episodes that it reported.
    pub episodes: u64,
    /// Environment frames of these episodes.
    pub env_frames: u64,
    /// Return of the newest.
    pub last_score: f64,
    /// Updates between the newest policy and the one that it acted by.
    pub policy_lag: u64,
}

/// A replay-server's words.
#[derive(Debug, Serialize)]
pub struct ReplayView {
    /// Where it was asked.
    pub address: String,
    /// Whether it answered; the rest is 0 and empty otherwise.
    pub up: bool,
    /// Steps held.
    pub steps: u64,
    /// Episodes held.
    pub episodes: u64,
    /// Bytes held.
    pub bytes: u64,
    /// Steps inserted since the store was made.
    pub inserted_steps: u64,
    /// Steps drawn under the limiter.
    pub sampled_steps: u64,
    /// Why inserts wait; empty where they do not.
    pub insert_waiting: String,
    /// Why draws wait; empty where they do not.
    pub sample_waiting: String,
}

impl Sources {
    /// Asks all of them at once.
    pub async fn ask(&self) -> Live {
        let mut asking = tokio::task::JoinSet::new();
        for (index, address) in self.replay.iter().cloned().enumerate() {
            let dialer = self.dialer.clone();
            asking.spawn(async move { (index, replay(&dialer, address).await) });
        }
        let learner = learner(&self.dialer, &self.learner).await;
        let mut replay = asking.join_all().await;
        replay.sort_by_key(|(index, _)| *index);
        Live {
            learner: learner.map(LearnerView::from),
            replay: replay.into_iter().map(|(_, view)| view).collect(),
        }
    }
}

async fn learner(dialer: &Dialer, address: &str) -> Option<v1::LearnerStatus> {
    let mut client = dialer.learner(address).ok()?;
    let answer = client.status(v1::LearnerStatusRequest {});
    let answer = tokio::time::timeout(ANSWER_DEADLINE, answer).await.ok()?;
    Some(answer.ok()?.into_inner())
}

async fn replay(dialer: &Dialer, address: String) -> ReplayView {
    let answer = async {
        let mut client = dialer.replay(&address).ok()?;
        let answer = client.status(v1::ReplayStatusRequest {});
        let answer = tokio::time::timeout(ANSWER_DEADLINE, answer).await.ok()?;
        Some(answer.ok()?.into_inner())
    };
    let answer = answer.await;
    let up = answer.is_some();
    let status = answer.unwrap_or_default();
    ReplayView {
        address,
        up,
        steps: status.steps,
        episodes: status.episodes,
        bytes: status.bytes,
        inserted_steps: status.inserted_steps,
        sampled_steps: status.sampled_steps,
        insert_waiting: status.insert_waiting,
        sample_waiting: status.sample_waiting,
    }
}

impl From<v1::LearnerStatus> for LearnerView {
    fn from(status: v1::LearnerStatus) -> Self {
        let score = |episodes: u64, value: f64| (episodes > 0).then_some(value);
        Self {
            collect_score: score(status.collect_episodes, status.collect_score),
            evaluate_score: score(status.evaluate_episodes, status.evaluate_score),
            actors: status.actors.into_iter().map(ActorView::from).collect(),
            phase: status.phase,
            updates: status.updates,
            total_updates: status.total_updates,
            updates_per_s: status.updates_per_s,
            env_frames: status.env_frames,
            env_frames_per_s: status.env_frames_per_s,
            wait_share: status.wait_share,
        }
    }
}

impl From<v1::ActorStatus> for ActorView {
    fn from(status: v1::ActorStatus) -> Self {
        Self {
            evaluates: status.role() == v1::ActorRole::Evaluate,
            id: status.actor_id,
            episodes: status.episodes,
            env_frames: status.env_frames,
            last_score: status.last_score,
            policy_lag: status.policy_lag,
        }
    }
}
