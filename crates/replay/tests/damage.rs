//! A thousand bit flips and truncations: all are reported, none panics, and what is served is what was written.

#![allow(clippy::unwrap_used, missing_docs)]

use std::fs;
use std::path::{Path, PathBuf};

use isodream_core::Chunk;
use isodream_replay::{Capacity, ReplayError, Selector, Store, StoreOptions, Table, verify};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const OPTIONS: StoreOptions = StoreOptions {
    capacity: Capacity::UNLIMITED,
    segment_bytes: 2000,
};
const CHUNKS: u64 = 60;

fn chunk(seq: u64) -> Chunk {
    Chunk {
        actor_id: "a".into(),
        epoch: 1,
        seq,
        episode_id: seq,
        first_step: 0,
        steps: 10,
        ends_episode: true,
        payload: (0..150).map(|byte| (byte * 13 + seq) as u8).collect(),
    }
}

/// Memory where there is some: thousands of small files are made.
fn folder() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").unwrap_or_else(|_| tempfile::tempdir().unwrap())
}

fn segments(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "log"))
        .collect();
    paths.sort();
    paths
}

fn copy(from: &Path, to: &Path) {
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
    }
}

#[test]
fn a_thousand_damages_are_all_reported_and_never_served() {
    let seed = rand::rng().next_u64();
    eprintln!("seed {seed}");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let intact = folder();
    let (mut writer, _, _) = Store::open(intact.path(), &OPTIONS).unwrap();
    for seq in (0..CHUNKS).step_by(3) {
        writer.commit((seq..seq + 3).map(chunk).collect()).unwrap();
    }
    drop(writer);
    let count = segments(intact.path()).len();
    assert!(count > 4);
    for round in 0..1000 {
        let damaged = folder();
        copy(intact.path(), damaged.path());
        let path = segments(damaged.path()).remove(rng.random_range(0..count));
        let mut content = fs::read(&path).unwrap();
        let at = rng.random_range(0..content.len());
        if round % 2 == 0 {
            content[at] ^= 1 << rng.random_range(0..8);
        } else {
            content.truncate(at);
        }
        fs::write(&path, &content).unwrap();
        let found = verify(damaged.path()).unwrap();
        assert!(
            found.damage.iter().any(|damage| damage.segment == path),
            "round {round}: damage at {at} of {} was not found",
            path.display()
        );
        serve(damaged.path());
    }
}

/// Draws until the damage is taken out of service: at opening, or when it is met.
fn serve(folder: &Path) {
    let (_writer, store, _) = Store::open(folder, &OPTIONS).unwrap();
    let table = Table::new("any", Selector::Episodes);
    let mut sampler = store.sampler(&table, 10, 1).unwrap();
    for draw in 0..30 * CHUNKS {
        if draw >= CHUNKS && !store.quarantined().is_empty() {
            break;
        }
        let Some(sequence) = sampler.draw() else {
            break;
        };
        match sequence.chunks[0].read() {
            Ok(found) => assert_eq!(found, chunk(sequence.episode_id)),
            Err(ReplayError::Damaged { reason, .. }) => {
                store.quarantine(&sequence.chunks[0], reason);
            }
            Err(error) => panic!("{error}"),
        }
    }
    // One place was damaged, in a segment of at most a dozen chunks.
    assert!(store.stats().steps >= (CHUNKS - 13) * 10);
    assert_eq!(store.quarantined().len(), 1);
}
