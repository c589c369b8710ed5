//! Chunks that tell where they belong, and short ways to store and read them.

use std::fs;
use std::path::{Path, PathBuf};

use isodream_core::Chunk;
use isodream_replay::{
    Capacity, Outcome, Recovery, Sampler, Selector, SequenceRef, Store, StoreOptions, StoreWriter,
    Table,
};

pub(crate) const ALL: StoreOptions = StoreOptions {
    capacity: Capacity::UNLIMITED,
    segment_bytes: 1 << 20,
};

pub(crate) fn open(folder: &Path, options: &StoreOptions) -> (StoreWriter, Store, Recovery) {
    Store::open(folder, options).unwrap()
}

/// A chunk whose payload names the episode and step of each of its steps: 12 bytes each.
pub(crate) fn chunk(
    actor_id: &str,
    epoch: u64,
    seq: u64,
    episode_id: u64,
    first_step: u32,
    steps: u32,
) -> Chunk {
    let mut payload = Vec::new();
    for step in first_step..first_step + steps {
        payload.extend_from_slice(&episode_id.to_le_bytes());
        payload.extend_from_slice(&step.to_le_bytes());
    }
    Chunk {
        actor_id: actor_id.into(),
        epoch,
        seq,
        episode_id,
        first_step,
        steps,
        ends_episode: false,
        payload: payload.into(),
    }
}

/// Chunks `seqs` of one actor's only episode, 10 steps each.
pub(crate) fn episode(seqs: std::ops::Range<u64>) -> Vec<Chunk> {
    seqs.map(|seq| chunk("a", 1, seq, 5, seq as u32 * 10, 10))
        .collect()
}

/// Draws as the paper does.
pub(crate) fn sampler(store: &Store, seed: u64, length: u32) -> Sampler {
    let table = Table::new("train", Selector::Episodes);
    store.sampler(&table, length, seed).unwrap()
}

pub(crate) fn store_all(writer: &mut StoreWriter, chunks: Vec<Chunk>) {
    for outcome in writer.commit(chunks).unwrap() {
        assert!(matches!(outcome, Outcome::Stored { .. }), "{outcome:?}");
    }
}

/// Episode and steps of a drawn sequence, as its bytes tell.
pub(crate) fn read(sequence: &SequenceRef, length: usize) -> (u64, Vec<u32>) {
    let bytes: Vec<u8> = sequence
        .chunks
        .iter()
        .flat_map(|chunk| chunk.read().unwrap().payload)
        .collect();
    let rows: Vec<(u64, u32)> = bytes
        .chunks_exact(12)
        .skip(sequence.offset as usize)
        .take(length)
        .map(|row| {
            (
                u64::from_le_bytes(row[..8].try_into().unwrap()),
                u32::from_le_bytes(row[8..].try_into().unwrap()),
            )
        })
        .collect();
    assert_eq!(rows.len(), length);
    assert!(
        rows.iter()
            .all(|(episode, _)| *episode == sequence.episode_id)
    );
    (
        sequence.episode_id,
        rows.into_iter().map(|(_, step)| step).collect(),
    )
}

pub(crate) fn segments(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "log"))
        .collect();
    paths.sort();
    paths
}
