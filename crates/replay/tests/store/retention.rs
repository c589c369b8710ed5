//! What goes when there is too much.

use std::fs;

use isodream_replay::{Capacity, StoreOptions};

use crate::common::{ALL, chunk, episode, open, sampler, segments, store_all};

#[test]
fn the_oldest_episodes_go_and_counters_and_positions_stay() {
    let folder = tempfile::tempdir().unwrap();
    let options = StoreOptions {
        capacity: Capacity::steps(100),
        segment_bytes: 600,
    };
    let (mut writer, store, _) = open(folder.path(), &options);
    for seq in 0..50 {
        // Ten steps an episode, one actor that falls silent early.
        let actor = if seq == 0 { "silent" } else { "a" };
        let seq_of_actor = u64::saturating_sub(seq, 1);
        let mut chunk = chunk(actor, 1, seq_of_actor, seq, 0, 10);
        chunk.ends_episode = true;
        store_all(&mut writer, vec![chunk]);
        assert!(store.stats().steps <= 100);
    }
    let stats = store.stats();
    assert_eq!(
        (stats.steps, stats.episodes, stats.inserted_steps),
        (100, 10, 500)
    );
    let on_disk: u64 = segments(folder.path())
        .iter()
        .map(|path| fs::metadata(path).unwrap().len())
        .sum();
    assert!(
        on_disk < 4000,
        "{on_disk} bytes on disk for {} held",
        stats.bytes
    );
    let mut sampler = sampler(&store, 1, 10);
    for _ in 0..50 {
        assert!(sampler.draw().unwrap().episode_id >= 40);
    }
    drop(writer);
    let (mut writer, store, _) = open(folder.path(), &options);
    assert_eq!(store.stats().inserted_steps, 500);
    assert!(store.stats().steps <= 100);
    assert_eq!(writer.begin("a", 1, 0).unwrap(), 49);
    assert_eq!(
        writer.begin("silent", 1, 0).unwrap(),
        1,
        "its chunks are gone, its position is not"
    );
}

#[test]
fn bytes_are_a_capacity_as_well() {
    let folder = tempfile::tempdir().unwrap();
    let options = StoreOptions {
        capacity: Capacity {
            bytes: 2000,
            ..Capacity::UNLIMITED
        },
        segment_bytes: 600,
    };
    let (mut writer, store, _) = open(folder.path(), &options);
    for seq in 0..60 {
        let mut chunk = chunk("a", 1, seq, seq, 0, 10);
        chunk.ends_episode = true;
        store_all(&mut writer, vec![chunk]);
        assert!(store.stats().bytes <= 2000);
    }
    let stats = store.stats();
    assert!(
        stats.episodes > 3 && stats.inserted_steps == 600,
        "{stats:?}"
    );
    assert!(segments(folder.path()).len() < 6, "nothing was deleted");
}

#[test]
fn one_episode_beyond_the_capacity_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let options = StoreOptions {
        capacity: Capacity::steps(20),
        ..ALL
    };
    let (mut writer, store, _) = open(folder.path(), &options);
    store_all(&mut writer, episode(0..5));
    assert_eq!(store.stats().steps, 50);
}
