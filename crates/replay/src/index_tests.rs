//! The index against a plain list of runs that is searched from end to end.

use std::collections::HashMap;

use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::Selector;

const LENGTH: u32 = 4;

#[derive(Debug, Clone)]
enum Change {
    /// One actor's next chunk; the last of its episode or not.
    Grow(u64, u32, bool),
    /// An actor's chunk is lost on the way.
    Skip(u64, u32),
    Evict(u64),
    Remove(prop::sample::Index),
    Prioritize(prop::sample::Index, f32),
}

fn change() -> impl Strategy<Value = Change> {
    let priority = prop_oneof![Just(0.0_f32), Just(1.0), Just(0.5), Just(9.0)];
    prop_oneof![
        12 => (0..3_u64, 1..7_u32, prop::bool::weighted(0.2)).prop_map(|(actor, steps, ends)| Change::Grow(actor, steps, ends)),
        1 => (0..3_u64, 1..7_u32).prop_map(|(actor, steps)| Change::Skip(actor, steps)),
        1 => (0..80_u64).prop_map(Change::Evict),
        2 => any::<prop::sample::Index>().prop_map(Change::Remove),
        4 => (any::<prop::sample::Index>(), priority).prop_map(|(at, to)| Change::Prioritize(at, to)),
    ]
}

#[derive(Debug, Clone)]
struct PlainRun {
    episode: u64,
    ended: bool,
    chunks: Vec<IndexedChunk>,
}

impl PlainRun {
    fn end(&self) -> u32 {
        self.chunks
            .last()
            .map_or(0, |last| last.first_step + last.steps)
    }
}

/// Oldest run first.
#[derive(Debug, Default)]
struct Plain {
    runs: Vec<PlainRun>,
    /// By episode and start step, in the fixed point of the selector.
    weights: HashMap<(u64, u32), u64>,
    greatest: u64,
    next_offset: u64,
    taken: Vec<(u64, u32)>,
}

type Key = (u64, u32);

impl Plain {
    fn chunk(&mut self, first_step: u32, steps: u32) -> IndexedChunk {
        self.next_offset += 10;
        IndexedChunk {
            segment: self.next_offset / 100,
            offset: self.next_offset,
            bytes: 3,
            first_step,
            steps,
        }
    }

    fn insert(&mut self, episode: u64, ended: bool, chunk: IndexedChunk) {
        let grows = |run: &&mut PlainRun| {
            run.episode == episode && !run.ended && run.end() == chunk.first_step
        };
        if let Some(run) = self.runs.iter_mut().rev().find(grows) {
            run.chunks.push(chunk);
            run.ended = ended;
        } else {
            self.runs.push(PlainRun {
                episode,
                ended,
                chunks: vec![chunk],
            });
        }
        for (key, _) in self.sequences() {
            self.weights.entry(key).or_insert(self.greatest);
        }
    }

    fn steps(&self) -> u64 {
        let chunks = self.runs.iter().flat_map(|run| &run.chunks);
        chunks.map(|chunk| u64::from(chunk.steps)).sum()
    }

    fn evict(&mut self, capacity: u64) {
        while self.steps() > capacity && self.runs.len() > 1 {
            self.runs.remove(0);
        }
    }

    fn remove(&mut self, run: usize, at: usize) {
        let mut front = self.runs.remove(run);
        let rest = PlainRun {
            chunks: front.chunks.split_off(at + 1),
            ..front.clone()
        };
        front.chunks.pop();
        front.ended = true;
        self.runs.extend([front, rest]);
        self.runs.retain(|run| !run.chunks.is_empty());
        self.runs.sort_by_key(|run| run.chunks[0].offset);
    }

    /// Every sequence and the number of sequences of its run, in the order in which their last steps came.
    fn sequences(&self) -> Vec<(Key, u32)> {
        let mut found = Vec::new();
        for run in &self.runs {
            let first = run.chunks[0].first_step;
            let starts = (run.end() - first).saturating_sub(LENGTH - 1);
            for chunk in &run.chunks {
                for step in chunk.first_step..chunk.first_step + chunk.steps {
                    if step + 1 >= first + LENGTH {
                        let key = (run.episode, step + 1 - LENGTH);
                        found.push(((chunk.offset, step), (key, starts)));
                    }
                }
            }
        }
        found.sort_by_key(|(order, _)| *order);
        found.into_iter().map(|(_, sequence)| sequence).collect()
    }

    fn probability(&self, selector: &Selector, key: Key) -> f64 {
        let all = self.sequences();
        let at = all.iter().position(|(held, _)| *held == key).unwrap();
        let count = all.len() as f64;
        let runs = || -> f64 {
            let runs: f64 = all.iter().map(|(_, starts)| 1.0 / f64::from(*starts)).sum();
            runs.round()
        };
        match *selector {
            Selector::Steps => 1.0 / count,
            Selector::Episodes => 1.0 / (runs() * f64::from(all[at].1)),
            Selector::Ends { probability } => {
                let (episode, first) = key;
                let is_last =
                    |run: &PlainRun| run.episode == episode && run.end() == first + LENGTH;
                let extra = if self.runs.iter().any(is_last) {
                    probability
                } else {
                    0.0
                };
                ((1.0 - probability) / f64::from(all[at].1) + extra) / runs()
            }
            Selector::Prioritized { .. } => {
                let total: u64 = all.iter().map(|(key, _)| self.weights[key]).sum();
                self.weights[&key] as f64 / total as f64
            }
            Selector::Fifo => 1.0,
            Selector::Recent {
                newest,
                probability,
            } => {
                let newest = newest.min(all.len() as u64);
                let new = at as u64 >= all.len() as u64 - newest;
                let extra = if new {
                    probability / newest as f64
                } else {
                    0.0
                };
                (1.0 - probability) / count + extra
            }
        }
    }
}

fn tables() -> Vec<Table> {
    [
        Selector::Steps,
        Selector::Episodes,
        Selector::Ends { probability: 0.25 },
        Selector::Prioritized { exponent: 0.5 },
        Selector::Fifo,
        Selector::Recent {
            newest: 7,
            probability: 0.75,
        },
    ]
    .into_iter()
    .map(|selector| Table {
        name: format!("{selector:?}"),
        selector,
    })
    .collect()
}

/// A sequence's chunks cover it and nothing else.
fn check_cover(plain: &Plain, sequence: &Sequence) {
    let run = plain
        .runs
        .iter()
        .find(|run| run.chunks.contains(&sequence.chunks[0]))
        .unwrap();
    let at = run
        .chunks
        .iter()
        .position(|chunk| *chunk == sequence.chunks[0])
        .unwrap();
    assert_eq!(
        run.chunks[at..at + sequence.chunks.len()],
        sequence.chunks[..]
    );
    let (first, last) = (
        sequence.chunks[0],
        sequence.chunks[sequence.chunks.len() - 1],
    );
    assert_eq!(first.first_step + sequence.offset, sequence.start_step);
    assert!(sequence.offset < first.steps);
    let end = sequence.start_step + LENGTH;
    assert!((last.first_step + 1..=last.first_step + last.steps).contains(&end));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(150))]

    #[test]
    fn every_draw_is_one_that_a_plain_list_allows(
        changes in prop::collection::vec(change(), 1..70),
        late in 0..70_usize,
        seed: u64,
    ) {
        let mut plain = Plain { greatest: 65_536, ..Plain::default() };
        let mut index = Index::default();
        let mut views = Vec::new();
        // Priorities and the queue remember; the others may as well be made of what is there.
        for table in tables() {
            let remembers = matches!(table.selector, Selector::Prioritized { .. } | Selector::Fifo);
            if remembers {
                let view = index.view(&table, LENGTH);
                views.push((table, view));
            }
        }
        let mut actors = [(0_u64, 0_u32), (1, 0), (2, 0)];
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for (at, change) in changes.into_iter().enumerate() {
            if at == late {
                for table in tables() {
                    if !views.iter().any(|(held, _)| *held == table) {
                        let view = index.view(&table, LENGTH);
                        views.push((table, view));
                    }
                }
            }
            match change {
                Change::Grow(actor, steps, ends) => {
                    let (episode, next) = actors[actor as usize];
                    let chunk = plain.chunk(next, steps);
                    plain.insert(episode, ends, chunk);
                    index.insert(episode, ends, chunk);
                    actors[actor as usize] = if ends { (episode + 3, 0) } else { (episode, next + steps) };
                }
                Change::Skip(actor, steps) => actors[actor as usize].1 += steps,
                Change::Evict(capacity) => {
                    let before = plain.runs.len();
                    plain.evict(capacity);
                    prop_assert_eq!(index.evict(Capacity::steps(capacity)), (before - plain.runs.len()) as u64);
                }
                Change::Remove(at) => {
                    let places: Vec<_> = plain.runs.iter().enumerate()
                        .flat_map(|(run, held)| (0..held.chunks.len()).map(move |at| (run, at)))
                        .collect();
                    if !places.is_empty() {
                        let (run, at) = places[at.index(places.len())];
                        let chunk = plain.runs[run].chunks[at];
                        plain.remove(run, at);
                        prop_assert!(index.remove(chunk.segment, chunk.offset));
                        prop_assert!(!index.remove(chunk.segment, chunk.offset));
                    }
                }
                Change::Prioritize(at, priority) => {
                    let known: Vec<_> = plain.weights.keys().copied().collect();
                    if !known.is_empty() {
                        let (episode_id, start_step) = known[at.index(known.len())];
                        let held = plain.sequences().iter().any(|(key, _)| *key == (episode_id, start_step));
                        let update = PriorityUpdate { episode_id, start_step, priority };
                        let view = &views.iter().find(|(table, _)| matches!(table.selector, Selector::Prioritized { .. })).unwrap().1;
                        let counts = index.update_priorities(view, &[update]);
                        prop_assert_eq!((counts.applied, counts.ignored), (u64::from(held), u64::from(!held)));
                        if held {
                            let weight = (f64::from(priority).sqrt() * 65_536.0).round() as u64;
                            plain.weights.insert((episode_id, start_step), weight);
                            plain.greatest = plain.greatest.max(weight);
                        }
                    }
                }
            }
            let stats = index.stats();
            prop_assert_eq!((stats.steps, stats.episodes), (plain.steps(), plain.runs.len() as u64));
            let chunks: Vec<_> = plain.runs.iter().flat_map(|run| &run.chunks).collect();
            prop_assert_eq!(stats.bytes, 3 * chunks.len() as u64);
            for segment in 0..=plain.next_offset / 100 {
                let live = chunks.iter().any(|chunk| chunk.segment == segment);
                prop_assert_eq!(index.is_live(segment), live);
            }
            for (table, view) in &views {
                let mut possible: Vec<_> = plain.sequences().into_iter().map(|(key, _)| key).collect();
                match table.selector {
                    Selector::Prioritized { .. } => possible.retain(|key| plain.weights[key] > 0),
                    Selector::Fifo => possible.retain(|key| !plain.taken.contains(key)),
                    _ => {}
                }
                prop_assert_eq!(index.can_draw(view), !possible.is_empty(), "{:?}", table);
                for _ in 0..4 {
                    let Some(drawn) = index.draw(view, &mut rng) else {
                        prop_assert!(possible.is_empty());
                        break;
                    };
                    let key = (drawn.episode_id, drawn.start_step);
                    check_cover(&plain, &drawn);
                    let expected = plain.probability(&table.selector, key);
                    prop_assert!((drawn.probability / expected - 1.0).abs() < 1e-9, "{:?}", table);
                    if table.selector == Selector::Fifo {
                        prop_assert_eq!(key, possible.remove(0));
                        plain.taken.push(key);
                    } else {
                        prop_assert!(possible.contains(&key));
                    }
                }
            }
        }
    }
}
