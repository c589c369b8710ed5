//! Which sequences are drawn.

use std::collections::HashMap;
use std::fs;

use isodream_replay::{PriorityUpdate, ReplayError, Sampler, Selector, Store, Table};

use crate::common::{ALL, chunk, episode, open, read, sampler, segments, store_all};

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

#[test]
fn a_segment_that_lost_its_end_is_damaged_and_no_disk_that_may_recover() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    store_all(&mut writer, episode(0..9));
    let place = sampler(&store, 0, 90).draw().unwrap().chunks.remove(8);
    let segment = fs::OpenOptions::new()
        .write(true)
        .open(segments(folder.path()).remove(0))
        .unwrap();
    segment.set_len(place.offset() + 10).unwrap();
    let error = place.read().unwrap_err();
    assert!(
        matches!(error, ReplayError::Damaged { .. }) && error.to_string().contains("its end"),
        "{error}"
    );
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
