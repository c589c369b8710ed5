//! The store as its server uses it: exactly once, fencing, eviction, reopening, sampling.

#![allow(clippy::unwrap_used, missing_docs)]

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use isodream_core::Chunk;
use isodream_replay::{
    Capacity, Outcome, PriorityUpdate, Recovery, ReplayError, Sampler, Selector, SequenceRef,
    Store, StoreIdentity, StoreOptions, StoreWriter, Table,
};

const ALL: StoreOptions = StoreOptions {
    capacity: Capacity::UNLIMITED,
    segment_bytes: 1 << 20,
};

fn open(folder: &Path, options: &StoreOptions) -> (StoreWriter, Store, Recovery) {
    Store::open(folder, options).unwrap()
}

/// A chunk whose payload names the episode and step of each of its steps: 12 bytes each.
fn chunk(
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
fn episode(seqs: std::ops::Range<u64>) -> Vec<Chunk> {
    seqs.map(|seq| chunk("a", 1, seq, 5, seq as u32 * 10, 10))
        .collect()
}

/// Draws as the paper does.
fn sampler(store: &Store, seed: u64, length: u32) -> Sampler {
    let table = Table::new("train", Selector::Episodes);
    store.sampler(&table, length, seed).unwrap()
}

fn store_all(writer: &mut StoreWriter, chunks: Vec<Chunk>) {
    for outcome in writer.commit(chunks).unwrap() {
        assert!(matches!(outcome, Outcome::Stored { .. }), "{outcome:?}");
    }
}

/// Episode and steps of a drawn sequence, as its bytes tell.
fn read(sequence: &SequenceRef, length: usize) -> (u64, Vec<u32>) {
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

fn segments(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "log"))
        .collect();
    paths.sort();
    paths
}

#[test]
fn a_chunk_sent_twice_is_stored_once_and_a_gap_is_answered() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    assert_eq!(writer.begin("a", 1, 0).unwrap(), 0);
    let mut group = episode(0..3);
    group.push(group[1].clone());
    group.push(episode(7..8).remove(0));
    assert_eq!(
        writer.commit(group).unwrap(),
        [
            Outcome::Stored { next_seq: 1 },
            Outcome::Stored { next_seq: 2 },
            Outcome::Stored { next_seq: 3 },
            Outcome::Duplicate { next_seq: 3 },
            Outcome::Gap { expected_seq: 3 },
        ]
    );
    assert_eq!(store.stats().steps, 30);
    drop(writer);
    let (mut writer, store, recovery) = open(folder.path(), &ALL);
    assert_eq!(recovery.chunks, 3);
    assert_eq!(store.stats().inserted_steps, 30);
    assert_eq!(writer.begin("a", 1, 0).unwrap(), 3);
    assert_eq!(
        writer.commit(episode(2..4)).unwrap(),
        [
            Outcome::Duplicate { next_seq: 3 },
            Outcome::Stored { next_seq: 4 }
        ]
    );
    let whole = sampler(&store, 0, 40).draw().unwrap();
    assert_eq!(read(&whole, 40).1, (0..40).collect::<Vec<_>>());
}

#[test]
fn an_invalid_chunk_is_refused_without_harm_to_its_group() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    let mut group = episode(0..2);
    group.insert(
        1,
        Chunk {
            steps: 0,
            ..group[0].clone()
        },
    );
    let outcomes = writer.commit(group).unwrap();
    assert!(matches!(&outcomes[1], Outcome::Invalid { reason } if reason.contains("no steps")));
    assert_eq!(outcomes[2], Outcome::Stored { next_seq: 2 });
    assert_eq!(store.stats().steps, 20);
}

#[test]
fn an_older_epoch_is_fenced_off_even_after_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, _, _) = open(folder.path(), &ALL);
    writer.begin("a", 1, 0).unwrap();
    store_all(&mut writer, episode(0..2));
    // No chunk of epoch 2 follows: the fence itself has to be durable.
    assert_eq!(writer.begin("a", 2, 0).unwrap(), 0);
    assert_eq!(
        writer.commit(episode(2..3)).unwrap(),
        [Outcome::Fenced { newer_epoch: 2 }]
    );
    drop(writer);
    let (mut writer, _, _) = open(folder.path(), &ALL);
    let error = writer.begin("a", 1, 2).unwrap_err();
    assert!(
        matches!(error, ReplayError::Fenced { newer: 2, .. }),
        "{error}"
    );
    assert_eq!(
        writer.commit(episode(2..3)).unwrap(),
        [Outcome::Fenced { newer_epoch: 2 }]
    );
    assert_eq!(writer.begin("b", 1, 0).unwrap(), 0, "other actors are free");
}

#[test]
fn an_actor_goes_on_where_a_reset_store_knows_less_than_it() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, _, _) = open(folder.path(), &ALL);
    assert_eq!(writer.begin("a", 1, 57).unwrap(), 57);
    store_all(&mut writer, episode(57..58));
    drop(writer);
    let (mut writer, _, _) = open(folder.path(), &ALL);
    assert_eq!(writer.begin("a", 1, 57).unwrap(), 58);
}

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

#[test]
fn episodes_of_several_actors_interleave() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    for seq in 0..6 {
        store_all(
            &mut writer,
            vec![
                chunk("a", 1, seq, 1, seq as u32 * 7, 7),
                chunk("b", 9, seq, 2, seq as u32 * 5, 5),
            ],
        );
    }
    assert_eq!(store.stats().episodes, 2);
    // One chunk covers it only where it starts right: offset and number of chunks are exact everywhere.
    let mut sampler = sampler(&store, 3, 12);
    for _ in 0..500 {
        let sequence = sampler.draw().unwrap();
        let (episode, steps) = read(&sequence, 12);
        assert!(steps.windows(2).all(|pair| pair[1] == pair[0] + 1));
        let per_chunk = if episode == 1 { 7 } else { 5 };
        assert_eq!(sequence.offset, steps[0] % per_chunk);
        let needed = steps[11] / per_chunk - steps[0] / per_chunk + 1;
        assert_eq!(sequence.chunks.len() as u32, needed);
    }
}

#[test]
fn sampling_is_uniform_over_episodes_and_then_over_starts() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    // Lengths 8, 12 and 30; one too short to be drawn; chunks of odd sizes.
    let mut seq = 0;
    for (episode, lengths) in [
        (1, vec![8]),
        (2, vec![5, 7]),
        (3, vec![11, 1, 18]),
        (4, vec![7]),
    ] {
        let mut first_step = 0;
        for steps in lengths {
            store_all(
                &mut writer,
                vec![chunk("a", 1, seq, episode, first_step, steps)],
            );
            seq += 1;
            first_step += steps;
        }
    }
    let draws = 30_000;
    let mut sampler = sampler(&store, 17, 8);
    let mut counts: HashMap<(u64, u32), u64> = HashMap::new();
    for _ in 0..draws {
        let (episode, steps) = read(&sampler.draw().unwrap(), 8);
        *counts.entry((episode, steps[0])).or_default() += 1;
    }
    for (episode, starts) in [(1_u64, 1_u32), (2, 5), (3, 23)] {
        let expected = f64::from(draws) / 3.0 / f64::from(starts);
        let chi_square: f64 = (0..starts)
            .map(|start| {
                let count = counts.remove(&(episode, start)).unwrap_or(0) as f64;
                (count - expected).powi(2) / expected
            })
            .sum();
        // 99.9 % quantile for 22 degrees of freedom is 48.3; for 4 it is 18.5; the bound is loose on purpose.
        assert!(
            chi_square < 55.0,
            "episode {episode}: chi square {chi_square}"
        );
    }
    assert!(counts.is_empty(), "drawn beyond an episode: {counts:?}");
}

#[test]
fn equal_seeds_draw_equal_sequences() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    store_all(&mut writer, episode(0..20));
    let draw = |seed| {
        let mut sampler = sampler(&store, seed, 15);
        (0..20)
            .map(|_| read(&sampler.draw().unwrap(), 15))
            .collect::<Vec<_>>()
    };
    assert_eq!(draw(1), draw(1));
    assert_ne!(draw(1), draw(2));
}

#[test]
fn nothing_is_drawn_from_too_little() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    assert!(sampler(&store, 0, 1).draw().is_none());
    store_all(&mut writer, episode(0..1));
    assert!(sampler(&store, 0, 10).can_draw());
    assert!(!sampler(&store, 0, 11).can_draw());
    assert!(sampler(&store, 0, 11).draw().is_none());
}

#[test]
fn damage_splits_an_episode_and_no_sequence_crosses_the_hole() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    store_all(&mut writer, episode(0..9));
    let place = sampler(&store, 0, 90).draw().unwrap().chunks.remove(4);
    let path = segments(folder.path()).remove(0);
    let mut content = fs::read(&path).unwrap();
    content[place.offset() as usize + 60] ^= 1;
    fs::write(&path, &content).unwrap();

    // Found while serving ...
    assert!(matches!(place.read(), Err(ReplayError::Damaged { .. })));
    store.quarantine(&place, "test");
    store.quarantine(&place, "test");
    check_the_hole(&store);
    assert_eq!(store.quarantined().len(), 1, "counted once");
    // ... the episode goes on behind it ...
    store_all(&mut writer, episode(9..10));
    assert_eq!(
        sampler(&store, 0, 50).draw().unwrap().chunks[0].first_step(),
        50
    );
    drop(writer);
    // ... and found again while opening; the position is not lost with it.
    let (mut writer, store, recovery) = open(folder.path(), &ALL);
    assert_eq!(recovery.quarantined.len(), 1);
    check_the_hole(&store);
    assert_eq!(writer.begin("a", 1, 0).unwrap(), 10);
}

fn check_the_hole(store: &Store) {
    let mut sampler = sampler(store, 5, 20);
    for _ in 0..300 {
        let (_, steps) = read(&sampler.draw().unwrap(), 20);
        assert!(
            steps.iter().all(|step| !(40..50).contains(step)),
            "{steps:?}"
        );
        assert!(steps.windows(2).all(|pair| pair[1] == pair[0] + 1));
    }
}

#[test]
fn tables_share_the_chunks_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    store_all(&mut writer, episode(0..3));
    let queue = |name| {
        let table = Table::new(name, Selector::Fifo);
        store.sampler(&table, 25, 0).unwrap()
    };
    let start = |sampler: &mut Sampler| sampler.draw().map(|sequence| sequence.start_step);
    let (mut first, mut again, mut other) = (queue("a"), queue("a"), queue("b"));
    assert_eq!(start(&mut first), Some(0));
    assert_eq!(start(&mut again), Some(1), "the same table");
    assert_eq!(start(&mut other), Some(0), "another table");
    let bytes = store.stats().bytes;
    for at in 2..6 {
        let drawn = first.draw().unwrap();
        assert_eq!(read(&drawn, 25).1, (at..at + 25).collect::<Vec<_>>());
    }
    assert_eq!(start(&mut first), None);
    assert!(other.can_draw());
    // Both see what arrives, and a table's place outlives its samplers.
    drop((first, again));
    store_all(&mut writer, episode(3..4));
    assert_eq!(start(&mut queue("a")), Some(6));
    assert_eq!(store.stats().bytes, bytes / 3 * 4, "stored once");
}

#[test]
fn tables_and_priorities_out_of_range_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    store_all(&mut writer, episode(0..3));
    let recent = |newest, probability| Selector::Recent {
        newest,
        probability,
    };
    for (selector, words) in [
        (Selector::Prioritized { exponent: -1.0 }, "exponent"),
        (Selector::Prioritized { exponent: f64::NAN }, "exponent"),
        (recent(0, 0.5), "newest"),
        (recent(1, 1.5), "probability"),
    ] {
        let error = store
            .sampler(&Table::new("odd", selector), 5, 0)
            .unwrap_err();
        let error = error.to_string();
        assert!(error.contains("`odd`") && error.contains(words), "{error}");
    }
    let table = Table::new("hard", Selector::Prioritized { exponent: 1.0 });
    assert!(store.sampler(&table, 0, 0).is_err());
    let hard = store.sampler(&table, 5, 0).unwrap();
    let update = |priority| PriorityUpdate {
        episode_id: 5,
        start_step: 0,
        priority,
    };
    let error = hard.update_priorities(&[update(1.0), update(-1.0)]);
    assert!(error.unwrap_err().to_string().contains("-1"));
    assert_eq!(store.stats().priorities.applied, 0, "nothing of the batch");
    hard.update_priorities(&[update(2.0)]).unwrap();
    assert_eq!(store.stats().priorities.applied, 1);
    assert!(sampler(&store, 0, 5).update_priorities(&[]).is_err());
}

#[test]
fn the_first_identity_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let identity = |hash: &str| StoreIdentity {
        env_spec_hash: hash.into(),
        env_spec: format!("environment {hash}"),
    };
    let (mut writer, _, _) = open(folder.path(), &ALL);
    assert_eq!(
        writer.adopt_identity(&identity("a")).unwrap(),
        identity("a")
    );
    drop(writer);
    let (mut writer, _, _) = open(folder.path(), &ALL);
    assert_eq!(
        writer.adopt_identity(&identity("b")).unwrap(),
        identity("a")
    );
}

#[test]
fn a_second_store_on_the_folder_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (_writer, _, _) = open(folder.path(), &ALL);
    assert!(matches!(
        Store::open(folder.path(), &ALL),
        Err(ReplayError::FolderInUse { .. })
    ));
}
