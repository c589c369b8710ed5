//! Where all synthetic actors write down what happened.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use isodream_proto::v1::PolicyVersion;
use serde::Serialize;

/// Durations in milliseconds.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub(super) struct Spread {
    pub(super) count: u64,
    pub(super) p50_ms: f64,
    pub(super) p99_ms: f64,
    pub(super) max_ms: f64,
}

/// How policies spread.
#[derive(Debug, Clone, Default, Serialize)]
pub(super) struct FanOut {
    /// Versions that began to spread during the measurement.
    pub(super) published: u64,
    /// Those that every actor has verified.
    pub(super) complete: u64,
    /// From a version's publication until an actor has verified it, over all actors and versions.
    pub(super) actors: Spread,
    /// From a version's publication until the last actor has verified it.
    pub(super) last_actor: Spread,
}

/// Shared by all actors.
#[derive(Debug)]
pub(super) struct Board {
    actors: u64,
    measuring: AtomicBool,
    pub(super) steps: AtomicU64,
    /// As they travel: compressed.
    pub(super) chunk_bytes: AtomicU64,
    pub(super) policy_bytes: AtomicU64,
    pub(super) reports: AtomicU64,
    pub(super) lost_reports: AtomicU64,
    pub(super) samples: AtomicU64,
    pub(super) sample_bytes: AtomicU64,
    appends: Mutex<Histogram<u64>>,
    versions: Mutex<BTreeMap<(u64, u64), Version>>,
    /// Actors with a durable chunk, and with a policy.
    pub(super) inserting: AtomicU64,
    pub(super) informed: AtomicU64,
}

#[derive(Debug)]
struct Version {
    published: Instant,
    measured: bool,
    verified: Vec<Duration>,
}

impl Board {
    pub(super) fn new(actors: u64) -> Self {
        Self {
            actors,
            measuring: AtomicBool::new(false),
            steps: AtomicU64::new(0),
            chunk_bytes: AtomicU64::new(0),
            policy_bytes: AtomicU64::new(0),
            reports: AtomicU64::new(0),
            lost_reports: AtomicU64::new(0),
            samples: AtomicU64::new(0),
            sample_bytes: AtomicU64::new(0),
            appends: Mutex::new(microseconds()),
            versions: Mutex::default(),
            inserting: AtomicU64::new(0),
            informed: AtomicU64::new(0),
        }
    }

    /// From now on, or not any more, what happens counts.
    pub(super) fn measure(&self, on: bool) {
        self.measuring.store(on, Ordering::Relaxed);
    }

    /// Adds to a counter, if this counts.
    pub(super) fn count(&self, counter: &AtomicU64, amount: u64) {
        if self.measuring.load(Ordering::Relaxed) {
            counter.fetch_add(amount, Ordering::Relaxed);
        }
    }

    /// A chunk became durable, so long after it was due.
    pub(super) fn appended(&self, steps: u32, bytes: usize, took: Duration) {
        self.count(&self.steps, u64::from(steps));
        self.count(&self.chunk_bytes, bytes as u64);
        if self.measuring.load(Ordering::Relaxed) {
            record(&mut lock(&self.appends), took);
        }
    }

    /// A version begins to spread: it is published, or, where others publish, the first actor hears of it.
    pub(super) fn published(&self, version: PolicyVersion) {
        let measured = self.measuring.load(Ordering::Relaxed);
        lock(&self.versions)
            .entry((version.learner_epoch, version.version))
            .or_insert_with(|| Version {
                published: Instant::now(),
                measured,
                verified: Vec::new(),
            });
    }

    /// An actor has verified a version.
    pub(super) fn verified(&self, version: PolicyVersion) {
        let key = (version.learner_epoch, version.version);
        if let Some(version) = lock(&self.versions).get_mut(&key) {
            version.verified.push(version.published.elapsed());
        }
    }

    pub(super) fn append_latency(&self) -> Spread {
        spread(&lock(&self.appends))
    }

    pub(super) fn fan_out(&self) -> FanOut {
        let (mut actors, mut last) = (microseconds(), microseconds());
        let mut result = FanOut::default();
        for version in lock(&self.versions).values() {
            if !version.measured {
                continue;
            }
            result.published += 1;
            for took in &version.verified {
                record(&mut actors, *took);
            }
            if version.verified.len() as u64 == self.actors {
                result.complete += 1;
                record(
                    &mut last,
                    version.verified.iter().max().copied().unwrap_or_default(),
                );
            }
        }
        result.actors = spread(&actors);
        result.last_actor = spread(&last);
        result
    }
}

/// Up to an hour, to a thousandth.
fn microseconds() -> Histogram<u64> {
    Histogram::new_with_max(3_600_000_000, 3).expect("the bounds are sound")
}

fn record(histogram: &mut Histogram<u64>, took: Duration) {
    histogram.saturating_record(took.as_micros() as u64);
}

fn spread(histogram: &Histogram<u64>) -> Spread {
    let ms = |microseconds: u64| microseconds as f64 / 1e3;
    Spread {
        count: histogram.len(),
        p50_ms: ms(histogram.value_at_quantile(0.5)),
        p99_ms: ms(histogram.value_at_quantile(0.99)),
        max_ms: ms(histogram.max()),
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn version(version: u64) -> PolicyVersion {
        PolicyVersion {
            learner_epoch: 1,
            version,
        }
    }

    #[test]
    fn a_version_is_complete_when_every_actor_has_it() {
        let board = Board::new(2);
        board.published(version(1));
        board.verified(version(1));
        board.measure(true);
        board.published(version(2));
        board.published(version(3));
        for _ in 0..2 {
            board.verified(version(2));
        }
        board.verified(version(3));
        let fan_out = board.fan_out();
        assert_eq!((fan_out.published, fan_out.complete), (2, 1));
        assert_eq!((fan_out.actors.count, fan_out.last_actor.count), (3, 1));
    }

    #[test]
    fn only_what_is_measured_counts() {
        let board = Board::new(1);
        let took = Duration::from_millis(20);
        board.appended(16, 100, took);
        board.measure(true);
        for _ in 0..99 {
            board.appended(16, 100, took);
        }
        board.appended(16, 100, 50 * took);
        board.measure(false);
        board.appended(16, 100, took);
        assert_eq!(board.steps.load(Ordering::Relaxed), 1600);
        assert_eq!(board.chunk_bytes.load(Ordering::Relaxed), 10_000);
        let spread = board.append_latency();
        assert_eq!(spread.count, 100);
        assert!((spread.p50_ms - 20.0).abs() < 0.1, "{spread:?}");
        assert!((spread.p99_ms - 20.0).abs() < 0.1, "{spread:?}");
        assert!((spread.max_ms - 1000.0).abs() < 2.0, "{spread:?}");
    }
}
