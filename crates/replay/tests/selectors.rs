//! How often each selector draws what, and what it remembers.

#![allow(clippy::unwrap_used, missing_docs)]

use std::collections::BTreeMap;

use isodream_replay::{Capacity, Index, IndexedChunk, PriorityUpdate, Selector, Table, ViewHandle};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const LENGTH: u32 = 8;

fn table(selector: Selector) -> Table {
    Table::new("any", selector)
}

/// Chunks of the given lengths make an episode; offsets go on.
fn insert(index: &mut Index, offset: &mut u64, episode: u64, lengths: &[u32]) {
    let mut first_step = 0;
    for &steps in lengths {
        let chunk = IndexedChunk {
            segment: 0,
            offset: *offset,
            bytes: 1,
            first_step,
            steps,
        };
        index.insert(episode, false, chunk);
        *offset += 1;
        first_step += steps;
    }
}

/// Episodes of 8, 12 and 30 steps, one too short to be drawn from, chunks of odd sizes, and one that went.
fn index() -> Index {
    let mut index = Index::default();
    let mut offset = 0;
    insert(&mut index, &mut offset, 0, &[40]);
    for (episode, lengths) in [
        (1, vec![8]),
        (2, vec![5, 7]),
        (3, vec![11, 1, 18]),
        (4, vec![7]),
    ] {
        insert(&mut index, &mut offset, episode, &lengths);
    }
    assert_eq!(index.evict(Capacity::steps(60)), 1);
    index
}

/// Episodes and start steps that can be drawn, in the order of arrival.
fn possible() -> Vec<(u64, u32)> {
    let starts = |episode, count| (0..count).map(move |start| (episode, start));
    starts(1, 1)
        .chain(starts(2, 5))
        .chain(starts(3, 23))
        .collect()
}

fn draws(index: &mut Index, view: &ViewHandle, seed: u64, count: usize) -> Vec<(u64, u32, f64)> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..count)
        .map(|_| {
            let drawn = index.draw(view, &mut rng).unwrap();
            (drawn.episode_id, drawn.start_step, drawn.probability)
        })
        .collect()
}

/// Draws many times and compares with `expected`, the probability of each of [`possible`].
fn check(index: &mut Index, selector: Selector, view: &ViewHandle, expected: &[f64]) {
    assert!(
        (expected.iter().sum::<f64>() - 1.0).abs() < 1e-9,
        "{expected:?}"
    );
    let count = 40_000;
    let mut found: BTreeMap<(u64, u32), u32> = BTreeMap::new();
    let expected: BTreeMap<_, _> = possible().into_iter().zip(expected).collect();
    for (episode, start, probability) in draws(index, view, 17, count) {
        let key = (episode, start);
        assert!(
            (probability - expected[&key]).abs() < 1e-4,
            "{selector:?} {key:?}: {probability}"
        );
        *found.entry(key).or_default() += 1;
    }
    let chi_square: f64 = expected
        .iter()
        .filter(|(_, expected)| ***expected > 0.0)
        .map(|(key, expected)| {
            let mean = *expected * count as f64;
            (f64::from(found.get(key).copied().unwrap_or(0)) - mean).powi(2) / mean
        })
        .sum();
    // The 99.9 % quantile for 28 degrees of freedom.
    assert!(chi_square < 56.9, "{selector:?}: chi square {chi_square}");
}

#[test]
fn frequencies_are_those_of_the_definitions() {
    let newest = 10;
    let cases = [
        (Selector::Steps, vec![1.0 / 29.0; 29]),
        (
            Selector::Episodes,
            [(1, 1), (2, 5), (3, 23)]
                .into_iter()
                .flat_map(|(_, starts)| vec![1.0 / 3.0 / f64::from(starts); starts as usize])
                .collect(),
        ),
        (
            Selector::Recent {
                newest,
                probability: 0.3,
            },
            (0..29)
                .map(|at| 0.7 / 29.0 + if at >= 19 { 0.3 / newest as f64 } else { 0.0 })
                .collect(),
        ),
    ];
    for (selector, expected) in cases {
        let mut index = index();
        let view = index.view(&table(selector), LENGTH);
        check(&mut index, selector, &view, &expected);
    }
}

#[test]
fn priorities_set_the_frequencies_by_their_power() {
    let selector = Selector::Prioritized { exponent: 0.5 };
    let mut index = index();
    let view = index.view(&table(selector), LENGTH);
    let updates: Vec<_> = possible()
        .into_iter()
        .enumerate()
        .map(|(at, (episode_id, start_step))| PriorityUpdate {
            episode_id,
            start_step,
            priority: at as f32,
        })
        .collect();
    let counts = index.update_priorities(&view, &updates);
    assert_eq!((counts.applied, counts.ignored), (29, 0));
    let total: f64 = (0..29).map(|at| f64::from(at).sqrt()).sum();
    let expected: Vec<_> = (0..29).map(|at| f64::from(at).sqrt() / total).collect();
    check(&mut index, selector, &view, &expected);
}

#[test]
fn priorities_stay_with_their_sequences_when_others_go() {
    let selector = Selector::Prioritized { exponent: 1.0 };
    let mut index = Index::default();
    let mut offset = 0;
    let view = index.view(&table(selector), LENGTH);
    for episode in 0..300 {
        insert(&mut index, &mut offset, episode, &[9, 9]);
    }
    let update = |episode_id, priority| PriorityUpdate {
        episode_id,
        start_step: 3,
        priority,
    };
    let counts = index.update_priorities(&view, &[update(250, 1000.0)]);
    assert_eq!((counts.applied, counts.ignored), (1, 0));
    assert_eq!(index.evict(Capacity::steps(18 * 100)), 200);
    let counts = index.update_priorities(&view, &[update(199, 5.0), update(200, 0.0)]);
    assert_eq!((counts.applied, counts.ignored), (1, 1));
    let heavy = 1000.0 / (1000.0 + 100.0 * 11.0 - 2.0);
    let drawn = draws(&mut index, &view, 3, 2000);
    assert!(
        drawn
            .iter()
            .all(|(episode, start, _)| *episode >= 200 && (*episode, *start) != (200, 3))
    );
    let of_heavy: Vec<_> = drawn
        .iter()
        .filter(|(episode, start, _)| (*episode, *start) == (250, 3))
        .collect();
    assert!((of_heavy[0].2 - heavy).abs() < 1e-9, "{}", of_heavy[0].2);
    // Six standard deviations.
    assert!(
        (of_heavy.len() as f64 - 2000.0 * heavy).abs() < 135.0,
        "{}",
        of_heavy.len()
    );
    // A new episode takes the greatest priority.
    insert(&mut index, &mut offset, 300, &[8]);
    let drawn = draws(&mut index, &view, 4, 2000);
    let new = drawn
        .iter()
        .find(|(episode, _, _)| *episode == 300)
        .unwrap();
    let total = 1000.0 + 100.0 * 11.0 - 2.0 + 1000.0;
    assert!((new.2 - 1000.0 / total).abs() < 1e-9);
}

#[test]
fn a_seed_draws_the_same_from_the_same_history() {
    for selector in [
        Selector::Steps,
        Selector::Episodes,
        Selector::Prioritized { exponent: 0.6 },
        Selector::Recent {
            newest: 5,
            probability: 0.5,
        },
    ] {
        let drawn = |seed| {
            let mut index = index();
            let view = index.view(&table(selector), LENGTH);
            draws(&mut index, &view, seed, 50)
        };
        assert_eq!(drawn(1), drawn(1));
        assert_ne!(drawn(1), drawn(2));
    }
}

#[test]
fn the_draws_of_a_seed_are_the_same_on_every_machine() {
    let starts = |selector| {
        let mut index = index();
        let view = index.view(&table(selector), LENGTH);
        draws(&mut index, &view, 1, 6)
            .into_iter()
            .map(|(episode, start, _)| (episode, start))
            .collect::<Vec<_>>()
    };
    let recent = Selector::Recent {
        newest: 5,
        probability: 0.5,
    };
    let found = [
        Selector::Steps,
        Selector::Episodes,
        Selector::Prioritized { exponent: 0.6 },
        recent,
    ]
    .map(starts);
    let expected = [
        [(3, 19), (3, 22), (3, 15), (3, 8), (3, 10), (3, 0)],
        [(2, 4), (1, 0), (1, 0), (3, 16), (2, 3), (1, 0)],
        [(3, 5), (2, 1), (3, 11), (3, 0), (3, 2), (3, 14)],
        [(3, 18), (3, 0), (3, 21), (3, 18), (3, 14), (3, 20)],
    ];
    assert_eq!(found, expected);
}
