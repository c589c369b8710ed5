//! Follows a run: whether updates and inserts move, and how far the replay ratio is off.

use std::fmt::{self, Display, Formatter};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use isodream_core::Config;
use isodream_proto::v1;

use crate::interrupt;
use crate::probe::Probe;

/// Pause between two looks: the resolution of every time to recover.
const LOOK: Duration = Duration::from_millis(200);

/// Counters as they were at one moment; none of a server that did not answer.
#[derive(Debug, Clone)]
struct Look {
    /// When the questions were asked.
    at: Instant,
    /// When the last answer was there.
    answered: Instant,
    updates: Option<u64>,
    replays: Vec<Option<v1::ReplayStatus>>,
}

/// How far stores were off their replay ratio at most.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Excess {
    /// Inserts ahead of sampling.
    pub(crate) inserted: Farthest,
    /// Sampling ahead of inserts.
    pub(crate) sampled: Farthest,
}

/// The greatest distance that was seen, and where.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Farthest {
    /// Sampled steps beyond the limiter's tolerance; 0 and less is within it.
    pub(crate) steps: f64,
    /// Index of the replay-server.
    server: usize,
    after: Duration,
}

impl Farthest {
    const NOTHING: Self = Self {
        steps: f64::NEG_INFINITY,
        server: 0,
        after: Duration::ZERO,
    };

    fn see(&mut self, steps: f64, server: usize, after: Duration) {
        if steps > self.steps {
            *self = Self {
                steps,
                server,
                after,
            };
        }
    }
}

impl Display for Farthest {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let (steps, after) = (self.steps, self.after.as_secs_f64());
        write!(f, "{steps:.0} at replay-{} after {after:.0} s", self.server)
    }
}

/// A server that is asked, from where it is asked.
#[derive(Debug)]
pub(crate) struct Watched {
    pub(crate) probe: Probe,
    pub(crate) address: String,
}

/// A thread that asks all servers again and again. Dropping it ends it.
#[derive(Debug)]
pub(crate) struct Watch {
    looks: Arc<Mutex<Vec<Look>>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    config: Config,
    streams: usize,
}

/// What has to move before a run counts as recovered, besides the learner's updates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Inserts {
    /// Inserts into any store.
    Any,
    /// Inserts into the store of this server.
    Into(usize),
}

impl Watch {
    /// `streams` is how many append streams may write to one server.
    pub(crate) fn start(
        learner: Watched,
        replays: Vec<Watched>,
        config: Config,
        streams: usize,
    ) -> Result<Self> {
        let looks = Arc::new(Mutex::new(Vec::new()));
        let stop = Arc::new(AtomicBool::new(false));
        let (seen, stopped) = (looks.clone(), stop.clone());
        let thread = std::thread::Builder::new()
            .name("watch".into())
            .spawn(move || {
                while !stopped.load(Ordering::Relaxed) {
                    let look = look(&learner, &replays);
                    seen.lock()
                        .unwrap_or_else(PoisonError::into_inner)
                        .push(look);
                    std::thread::sleep(LOOK);
                }
            })?;
        Ok(Self {
            looks,
            stop,
            thread: Some(thread),
            config,
            streams,
        })
    }

    /// Seconds from `since` until updates and inserts were both seen to move again.
    pub(crate) fn recovery(
        &self,
        since: Instant,
        inserts: Inserts,
        deadline: Duration,
    ) -> Result<f64> {
        let what = format!("updates and inserts ({inserts:?}) move again");
        let at = interrupt::until(&what, deadline, || Ok(self.moves(since, inserts)))
            .with_context(|| self.last_words())?;
        Ok(at.duration_since(since).as_secs_f64())
    }

    /// When updates and inserts had both been seen to move since `since`, if they have.
    pub(crate) fn moves(&self, since: Instant, inserts: Inserts) -> Option<Instant> {
        let looks = self.since(since);
        let updates = first_move(&looks, |look| look.updates)?;
        let store = |index: usize| {
            first_move(&looks, move |look| {
                Some(look.replays.get(index)?.as_ref()?.inserted_steps)
            })
        };
        let moved = match inserts {
            Inserts::Into(index) => store(index),
            Inserts::Any => (0..looks.first().map_or(0, |look| look.replays.len()))
                .filter_map(store)
                .min(),
        };
        Some(updates.max(moved?))
    }

    /// What the servers said of themselves last.
    pub(crate) fn last_words(&self) -> String {
        let looks = self.looks.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(look) = looks.last() else {
            return "nobody was asked".to_owned();
        };
        let mut words = format!("learner: {:?} updates", look.updates);
        for (server, status) in look.replays.iter().enumerate() {
            words += &match status {
                Some(status) => format!(
                    "; replay-{server}: {} inserted, {} sampled, inserts wait: `{}`, draws wait: `{}`",
                    status.inserted_steps,
                    status.sampled_steps,
                    status.insert_waiting,
                    status.sample_waiting
                ),
                None => format!("; replay-{server}: no answer"),
            };
        }
        words
    }

    /// Whether anything was inserted into the store of server `index` within the last `window`.
    pub(crate) fn inserts_move(&self, index: usize, window: Duration) -> bool {
        let begin = Instant::now().checked_sub(window);
        let looks = begin.map_or_else(Vec::new, |begin| self.since(begin));
        first_move(&looks, |look| {
            Some(look.replays.get(index)?.as_ref()?.inserted_steps)
        })
        .is_some()
    }

    /// The newest number of updates that is known.
    pub(crate) fn updates(&self) -> u64 {
        let looks = self.looks.lock().unwrap_or_else(PoisonError::into_inner);
        looks
            .iter()
            .rev()
            .find_map(|look| look.updates)
            .unwrap_or(0)
    }

    /// The greatest excess over the limiter's bounds since `since`. A server whose learner has not greeted it since
    /// its start counts no samples and is left out; `rollback` sampled steps are what a learner that was killed may
    /// have to draw again.
    pub(crate) fn excess(&self, since: Instant, rollback: u64) -> Excess {
        let (min_steps, ratio) = (
            self.config.learner.prefill_steps as f64,
            self.config.samples_per_insert(),
        );
        let tolerance =
            self.config.replay.limiter_tolerance_batches * self.config.batch_steps() as f64;
        // "A side is ahead by at most the tolerance and one operation."
        let one_insert = self.config.replay.chunk_steps as f64 * ratio;
        let one_draw = self.config.learner.batch_length as f64;
        // A status tells what is durable; the limiter also counts what each stream was let in with.
        let in_work = self.streams as f64 * one_insert;
        let mut excess = Excess {
            inserted: Farthest::NOTHING,
            sampled: Farthest::NOTHING,
        };
        for look in self.since(since) {
            let after = look.at.duration_since(since);
            for (server, status) in look.replays.iter().enumerate() {
                let Some(status) = status.as_ref().filter(|status| status.sampled_steps > 0) else {
                    continue;
                };
                let due = (status.inserted_steps as f64 - min_steps) * ratio;
                let surplus = due - status.sampled_steps as f64;
                let inserted = surplus - tolerance - one_insert - rollback as f64;
                excess.inserted.see(inserted, server, after);
                let sampled = -surplus - tolerance - one_draw - in_work;
                excess.sampled.see(sampled, server, after);
            }
        }
        excess
    }

    fn since(&self, since: Instant) -> Vec<Look> {
        let looks = self.looks.lock().unwrap_or_else(PoisonError::into_inner);
        let from = looks.partition_point(|look| look.at < since);
        looks.get(from..).unwrap_or_default().to_vec()
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn look(learner: &Watched, replays: &[Watched]) -> Look {
    let at = Instant::now();
    let status = learner.probe.learner(&learner.address);
    let updates = status.map(|status| status.updates);
    let replays = replays
        .iter()
        .map(|replay| replay.probe.replay(&replay.address))
        .collect();
    Look {
        at,
        answered: Instant::now(),
        updates,
        replays,
    }
}

/// When a counter was first seen to be greater than it was seen before.
fn first_move(looks: &[Look], counter: impl Fn(&Look) -> Option<u64>) -> Option<Instant> {
    let mut before = None;
    for look in looks {
        let Some(now) = counter(look) else { continue };
        if before.is_some_and(|before| now > before) {
            return Some(look.answered);
        }
        before = Some(now);
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_growth_counts_as_a_move() {
        let begin = Instant::now();
        let looks: Vec<Look> = [None, Some(9), Some(9), None, Some(4), Some(4), Some(5)]
            .into_iter()
            .enumerate()
            .map(|(second, updates)| Look {
                at: begin,
                answered: begin + Duration::from_secs(second as u64),
                updates,
                replays: Vec::new(),
            })
            .collect();
        let moved = first_move(&looks, |look| look.updates);
        assert_eq!(moved, Some(begin + Duration::from_secs(6)));
        assert_eq!(first_move(&looks[..6], |look| look.updates), None);
    }
}
