//! How long a store takes to open: `cargo bench -p isodream-replay --bench restart -- [STEPS [DIR]]`.
//!
//! Fills a folder with chunks of 16 steps of about 2 KB each and opens it five times more. A folder that is given is
//! kept and used again, so that its pages can be dropped from memory between two calls.

#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use std::path::{Path, PathBuf};
use std::time::Instant;

use isodream_core::Chunk;
use isodream_replay::{Capacity, Store, StoreOptions, StoreWriter};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const CHUNK_STEPS: u32 = 16;
const EPISODE_STEPS: u32 = 500;
const STORED_BYTES_PER_STEP: usize = 2048;
const ACTORS: u64 = 8;

fn main() {
    let mut arguments = std::env::args().skip(1).filter(|word| word != "--bench");
    let steps: u64 = arguments
        .next()
        .map_or(1_000_000, |word| word.parse().unwrap());
    let own = tempfile::tempdir().unwrap();
    let folder = arguments
        .next()
        .map_or_else(|| own.path().to_owned(), PathBuf::from);
    let options = StoreOptions {
        capacity: Capacity::UNLIMITED,
        ..StoreOptions::default()
    };
    fill(&folder, &options, steps);
    for _ in 0..5 {
        open(&folder, &options);
    }
}

fn open(folder: &Path, options: &StoreOptions) -> (StoreWriter, Store) {
    let since = Instant::now();
    let (writer, store, recovery) = Store::open(folder, options).unwrap();
    let seconds = since.elapsed().as_secs_f64();
    let stats = store.stats();
    println!(
        "opened {} steps, {:.0} MB, {} segments in {seconds:.3} s",
        stats.steps,
        stats.bytes as f64 / 1e6,
        recovery.segments
    );
    (writer, store)
}

/// Appends until the folder holds `steps` steps.
fn fill(folder: &Path, options: &StoreOptions, steps: u64) {
    let (mut writer, store) = open(folder, options);
    let mut noise = vec![0; STORED_BYTES_PER_STEP * CHUNK_STEPS as usize];
    ChaCha8Rng::seed_from_u64(1).fill_bytes(&mut noise);
    let payload = bytes::Bytes::from(noise);
    let mut next_seqs: Vec<u64> = (0..ACTORS)
        .map(|actor| writer.begin(&format!("actor-{actor}"), 1, 0).unwrap())
        .collect();
    while store.stats().steps < steps {
        let mut group = Vec::new();
        for (actor, next_seq) in (0..).zip(&mut next_seqs) {
            let chunks_per_episode = u64::from(EPISODE_STEPS.div_ceil(CHUNK_STEPS));
            let first_step = (*next_seq % chunks_per_episode) as u32 * CHUNK_STEPS;
            let steps = CHUNK_STEPS.min(EPISODE_STEPS - first_step);
            group.push(Chunk {
                actor_id: format!("actor-{actor}"),
                epoch: 1,
                seq: *next_seq,
                episode_id: *next_seq / chunks_per_episode * ACTORS + actor,
                first_step,
                steps,
                ends_episode: first_step + steps == EPISODE_STEPS,
                payload: payload.slice(..STORED_BYTES_PER_STEP * steps as usize),
            });
            *next_seq += 1;
        }
        writer.commit(group).unwrap();
    }
}
