//! What the learner knows of the run: its own pace, and the episodes that actors report.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Mutex;
use std::time::Instant;

use isodream_proto::v1;

use crate::evaluations::set_apart;

/// Episodes whose mean is shown as the collecting score.
const SCORE_WINDOW: usize = 10;

/// Measurements, one a second or so, that rates are taken over: an update may take longer than the time between two.
const RATE_WINDOW: usize = 10;

/// Reports kept for the metrics between two visits of the training thread.
const PENDING_REPORTS: usize = 10_000;

/// Shared between training thread and service.
#[derive(Debug)]
pub(crate) struct Progress {
    inner: Mutex<Inner>,
}

#[derive(Debug)]
struct Inner {
    status: v1::LearnerStatus,
    recent: VecDeque<f64>,
    evaluation: Vec<f64>,
    evaluated: Option<v1::PolicyVersion>,
    actors: BTreeMap<String, Actor>,
    pending: VecDeque<v1::EpisodeReport>,
    action_repeat: u64,
    /// The newest [`RATE_WINDOW`].
    measured: VecDeque<Measurement>,
}

#[derive(Debug)]
struct Actor {
    status: v1::ActorStatus,
    policy: Option<v1::PolicyVersion>,
}

/// How far the run was at one moment.
#[derive(Debug, Clone, Copy)]
struct Measurement {
    at: Instant,
    updates: u64,
    frames: u64,
}

impl Progress {
    pub(crate) fn new(
        updates: u64,
        total_updates: u64,
        env_frames: u64,
        action_repeat: u32,
    ) -> Self {
        Self {
            inner: Mutex::new(Inner {
                status: v1::LearnerStatus {
                    updates,
                    total_updates,
                    env_frames,
                    ..v1::LearnerStatus::default()
                },
                recent: VecDeque::new(),
                evaluation: Vec::new(),
                evaluated: None,
                actors: BTreeMap::new(),
                pending: VecDeque::new(),
                action_repeat: u64::from(action_repeat),
                measured: VecDeque::from([Measurement {
                    at: Instant::now(),
                    updates,
                    frames: env_frames,
                }]),
            }),
        }
    }

    /// Sets what only the training thread knows.
    pub(crate) fn set(&self, change: impl FnOnce(&mut v1::LearnerStatus)) {
        change(&mut self.lock().status);
    }

    /// Recomputes the rates, once per second or so.
    pub(crate) fn measure_pace(&self) {
        let mut inner = self.lock();
        let Inner {
            measured, status, ..
        } = &mut *inner;
        let now = Measurement {
            at: Instant::now(),
            updates: status.updates,
            frames: status.env_frames,
        };
        let first = measured.front().copied().unwrap_or(now);
        let secs = now.at.duration_since(first.at).as_secs_f64();
        if secs > 0.0 {
            status.updates_per_s = now.updates.saturating_sub(first.updates) as f64 / secs;
            status.env_frames_per_s = now.frames.saturating_sub(first.frames) as f64 / secs;
        }
        if measured.len() == RATE_WINDOW {
            measured.pop_front();
        }
        measured.push_back(now);
    }

    /// Takes in an actor's report.
    pub(crate) fn report(&self, mut report: v1::EpisodeReport) {
        set_apart(&mut report);
        let mut inner = self.lock();
        let action_repeat = inner.action_repeat;
        let actor = inner
            .actors
            .entry(report.actor_id.clone())
            .or_insert_with(|| Actor {
                status: v1::ActorStatus {
                    actor_id: report.actor_id.clone(),
                    role: report.role,
                    ..v1::ActorStatus::default()
                },
                policy: None,
            });
        actor.status.episodes += 1;
        actor.status.env_frames += u64::from(report.length) * action_repeat;
        actor.status.last_score = report.score;
        actor.policy = report.policy;
        match report.role() {
            v1::ActorRole::Evaluate => {
                if inner.evaluated != report.policy {
                    inner.evaluated = report.policy;
                    inner.evaluation.clear();
                }
                inner.evaluation.push(report.score);
                inner.status.evaluate_score = mean(inner.evaluation.iter());
                inner.status.evaluate_episodes += 1;
            }
            _ => {
                if inner.recent.len() == SCORE_WINDOW {
                    inner.recent.pop_front();
                }
                inner.recent.push_back(report.score);
                inner.status.collect_score = mean(inner.recent.iter());
                inner.status.collect_episodes += 1;
            }
        }
        if inner.pending.len() == PENDING_REPORTS {
            inner.pending.pop_front();
        }
        inner.pending.push_back(report);
    }

    /// Reports since the last call.
    pub(crate) fn take_reports(&self) -> Vec<v1::EpisodeReport> {
        self.lock().pending.drain(..).collect()
    }

    /// Environment frames seen by replay.
    pub(crate) fn env_frames(&self) -> u64 {
        self.lock().status.env_frames
    }

    /// The status as actors, supervisors and people see it.
    pub(crate) fn status(&self) -> v1::LearnerStatus {
        let inner = self.lock();
        let mut status = inner.status.clone();
        let newest = status.policy.map_or(0, |policy| policy.version);
        status.actors = inner
            .actors
            .values()
            .map(|actor| v1::ActorStatus {
                policy_lag: actor
                    .policy
                    .map_or(0, |policy| newest.saturating_sub(policy.version)),
                ..actor.status.clone()
            })
            .collect();
        status
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        // Nothing panics while it holds the lock, and counters would be whole even then.
        self.inner
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

fn mean<'a>(values: impl ExactSizeIterator<Item = &'a f64>) -> f64 {
    let count = values.len() as f64;
    values.sum::<f64>() / count
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_second_without_an_update_is_no_standstill_and_ten_are() {
        let progress = Progress::new(5, 100, 40, 4);
        let measured = |updates| {
            progress.set(|status| status.updates = updates);
            std::thread::sleep(Duration::from_millis(2));
            progress.measure_pace();
            progress.status().updates_per_s
        };
        assert_eq!(measured(5), 0.0, "only what this process makes counts");
        for _ in 1..RATE_WINDOW {
            assert!(measured(6) > 0.0);
        }
        assert!(
            measured(6) > 0.0,
            "the measurement before the update is the oldest"
        );
        assert_eq!(measured(6), 0.0);
    }
}
