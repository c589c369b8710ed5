//! What the roles of a simulation know, and what has to be true of the stores in the end.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use isodream_core::Chunk;
use isodream_replay::{Selector, Store, StoreOptions, Table};
use isodream_rpc::SampledSequence;

use crate::roles::{LENGTH, LIMITER, PREFETCH, SPOOL_CHUNKS, STEPS};

/// A chunk by its actor, the actor's start and its index there.
pub(crate) type Key = (usize, u64, u32);

#[derive(Default)]
pub(crate) struct Record {
    /// How often each actor was started.
    pub(crate) starts: BTreeMap<usize, u64>,
    /// What was acknowledged to an actor.
    pub(crate) acknowledged: BTreeSet<Key>,
    /// What the learner has used, as its checkpoint would keep it.
    pub(crate) sampled_steps: BTreeMap<String, u64>,
    pub(crate) sequences: u64,
    pub(crate) actors_done: usize,
    /// Times that chunks on their way were lost with their actor.
    pub(crate) actors_lost: u64,
    /// Times that an actor was refused though it was the newest.
    pub(crate) actors_refused: u64,
}

pub(crate) type Shared = Arc<Mutex<Record>>;

/// Chunk `index` of a start; five make an episode.
pub(crate) fn chunk((actor, start, index): Key) -> Chunk {
    Chunk {
        actor_id: name(actor),
        epoch: 0,
        seq: 0,
        episode_id: (actor as u64) << 32 | start << 16 | u64::from(index / 5),
        first_step: index % 5 * STEPS,
        steps: STEPS,
        ends_episode: index % 5 == 4,
        payload: payload((actor, start, index)),
    }
}

fn payload((actor, start, index): Key) -> Bytes {
    let text = format!("{actor} {start} {index} ");
    text.repeat(1 + index as usize % 50).into()
}

pub(crate) fn name(actor: usize) -> String {
    format!("actor-{actor}")
}

/// Which chunk it is, if it is byte for byte what was sent.
fn key(chunk: &Chunk) -> Key {
    let text = String::from_utf8(chunk.payload.to_vec()).expect("text");
    let mut numbers = text.split(' ');
    let mut number = || {
        numbers
            .next()
            .expect("a number")
            .parse::<u64>()
            .expect("a number")
    };
    let key = (number() as usize, number(), number() as u32);
    let mut sent = self::chunk(key);
    (sent.epoch, sent.seq) = (chunk.epoch, chunk.seq);
    assert_eq!(*chunk, sent, "damaged");
    key
}

/// A sequence is steps of one episode in order, as they were sent.
pub(crate) fn check_sequence(sequence: &SampledSequence) {
    let first = &sequence.chunks[0];
    assert!(sequence.offset < first.steps);
    for (chunk, index) in sequence.chunks.iter().zip(0..) {
        key(chunk);
        assert_eq!(chunk.episode_id, first.episode_id);
        assert_eq!(chunk.first_step, first.first_step + index * STEPS, "a gap");
    }
    let steps: u32 = sequence.chunks.iter().map(|chunk| chunk.steps).sum();
    assert!(steps - sequence.offset >= LENGTH, "too short");
}

/// Everything that a store holds, in the order of its log.
struct Stored {
    id: String,
    inserted_steps: u64,
    chunks: Vec<Chunk>,
}

fn read(folder: &Path) -> Stored {
    let since = Instant::now();
    // The commit thread of the last crash lets go of the folder in its own time.
    let (writer, store, recovery) = loop {
        match Store::open(folder, &StoreOptions::default()) {
            Ok(opened) => break opened,
            Err(error) if since.elapsed() > Duration::from_secs(10) => panic!("{error}"),
            Err(_) => std::thread::sleep(Duration::from_millis(1)),
        }
    };
    assert!(recovery.quarantined.is_empty());
    let mut chunks = BTreeMap::new();
    let table = Table::new("any", Selector::Episodes);
    let mut sampler = store.sampler(&table, STEPS, 1).expect("valid");
    // Far more draws than it takes to see each once.
    for _ in 0..recovery.chunks * 200 {
        if chunks.len() as u64 == recovery.chunks {
            break;
        }
        for place in sampler.draw().expect("not empty").chunks {
            let position = (place.segment(), place.offset());
            chunks
                .entry(position)
                .or_insert_with(|| place.read().expect("whole"));
        }
    }
    assert_eq!(
        chunks.len() as u64,
        recovery.chunks,
        "some were never drawn"
    );
    Stored {
        id: writer.store_id().to_owned(),
        inserted_steps: store.stats().inserted_steps,
        chunks: chunks.into_values().collect(),
    }
}

impl Record {
    pub(crate) fn check_stores(&self, folders: &[&Path]) {
        assert!(
            self.actors_refused <= 3,
            "the newest process of an actor was refused {} times",
            self.actors_refused
        );
        let mut everywhere = BTreeSet::new();
        for folder in folders {
            let stored = read(folder);
            let mut positions = BTreeMap::<usize, (u64, u64, u64)>::new();
            for chunk in &stored.chunks {
                let key = key(chunk);
                assert!(everywhere.insert(key), "{key:?} is stored twice");
                let (actor, start, _) = key;
                let (of_start, epoch, next_seq) = positions.entry(actor).or_default();
                assert!(
                    chunk.epoch >= *epoch,
                    "{key:?} was written after epoch {epoch}"
                );
                if chunk.epoch > *epoch {
                    (*of_start, *epoch, *next_seq) = (start, chunk.epoch, 0);
                }
                assert_eq!(start, *of_start, "{key:?}: two processes have one epoch");
                assert_eq!(chunk.seq, *next_seq, "{key:?} has a gap before it");
                *next_seq += 1;
            }
            self.check_limiter(&stored);
        }
        for key in &self.acknowledged {
            assert!(
                everywhere.contains(key),
                "{key:?} was acknowledged and is lost"
            );
        }
    }

    fn check_limiter(&self, stored: &Stored) {
        let inserted = stored.inserted_steps as f64;
        let sampled = self.sampled_steps.get(&stored.id).copied().unwrap_or(0) as f64;
        let surplus = (inserted - LIMITER.min_steps as f64) * LIMITER.samples_per_insert - sampled;
        let chunk = f64::from(STEPS) * LIMITER.samples_per_insert;
        // Drawn for the learner, which has not used it.
        let ahead = f64::from(LENGTH) * PREFETCH as f64;
        assert!(
            surplus <= LIMITER.tolerance_steps + chunk + ahead,
            "{surplus} sampled steps are due: inserts did not wait"
        );
        // Admitted, and lost with their actor before they were durable.
        let lost = (self.actors_lost * SPOOL_CHUNKS as u64) as f64 * chunk;
        assert!(
            -surplus <= LIMITER.tolerance_steps + f64::from(LENGTH) + lost,
            "{} steps were sampled too many: samples did not wait",
            -surplus
        );
    }
}
