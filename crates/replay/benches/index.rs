//! The index without files: draws, priority updates and insertions per second at 1M to 100M steps, and the
//! bytes that a step takes (`cargo bench -p isodream-replay --bench index`; about 2 GiB of memory).
//!
//! Episodes of 500 steps in chunks of 16, growing 16 at a time, sequences of 50 steps.

#![allow(clippy::print_stdout, clippy::unwrap_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Mutex, MutexGuard};

use divan::Bencher;
use divan::counter::ItemsCount;
use isodream_replay::{Capacity, Index, IndexedChunk, PriorityUpdate, Selector, Table, ViewHandle};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const SIZES: [u64; 3] = [1_000_000, 10_000_000, 100_000_000];
const EPISODE_STEPS: u32 = 500;
const CHUNK_STEPS: u32 = 16;
const ACTORS: u64 = 16;
const LENGTH: u32 = 50;
const DRAWS: usize = 1_000;
const UPDATES: usize = 1_000;

const SELECTORS: [(&str, Selector); 5] = [
    ("steps", Selector::Steps),
    ("episodes", Selector::Episodes),
    ("prioritized", Selector::Prioritized { exponent: 0.6 }),
    ("fifo", Selector::Fifo),
    (
        "recent",
        Selector::Recent {
            newest: 100_000,
            probability: 0.5,
        },
    ),
];

/// Counts the bytes that are allocated.
struct Counting;

static ALLOCATED: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATED.fetch_add(layout.size(), Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        ALLOCATED.fetch_sub(layout.size(), Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Indices by size, made once.
static FILLED: Mutex<Vec<(u64, Index)>> = Mutex::new(Vec::new());

/// Adds whole episodes of all actors, their chunks in turns.
fn insert_episodes(index: &mut Index, offset: &mut u64, first_episode: u64) {
    for first_step in (0..EPISODE_STEPS).step_by(CHUNK_STEPS as usize) {
        let steps = CHUNK_STEPS.min(EPISODE_STEPS - first_step);
        let ends = first_step + steps == EPISODE_STEPS;
        for actor in 0..ACTORS {
            let chunk = IndexedChunk {
                segment: *offset >> 26,
                offset: *offset,
                bytes: 16_000,
                first_step,
                steps,
            };
            *offset += 16_000;
            index.insert(first_episode + actor, ends, chunk);
        }
    }
}

fn episodes(steps: u64) -> u64 {
    steps / u64::from(EPISODE_STEPS) / ACTORS * ACTORS
}

fn fill(steps: u64, selector: Option<Selector>) -> Index {
    let mut index = Index::default();
    if let Some(selector) = selector {
        index.view(&table(selector), LENGTH);
    }
    let mut offset = 0;
    for first in (0..episodes(steps)).step_by(ACTORS as usize) {
        insert_episodes(&mut index, &mut offset, first);
    }
    index
}

fn table(selector: Selector) -> Table {
    Table::new(format!("{selector:?}"), selector)
}

/// Runs `work` on the index of that size and a view of the selector.
fn with_view(steps: u64, selector: Selector, work: impl FnOnce(&mut Index, &ViewHandle)) {
    let mut filled: MutexGuard<'_, Vec<(u64, Index)>> = FILLED.lock().unwrap();
    if !filled.iter().any(|(size, _)| *size == steps) {
        filled.push((steps, fill(steps, None)));
    }
    let (_, index) = filled.iter_mut().find(|(size, _)| *size == steps).unwrap();
    let view = index.view(&table(selector), LENGTH);
    work(index, &view);
}

struct Case {
    name: &'static str,
    selector: Selector,
    steps: u64,
}

impl fmt::Display for Case {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, {}M steps", self.name, self.steps / 1_000_000)
    }
}

fn cases() -> impl Iterator<Item = Case> {
    SELECTORS.into_iter().flat_map(|(name, selector)| {
        SIZES.map(move |steps| Case {
            name,
            selector,
            steps,
        })
    })
}

#[divan::bench(args = cases())]
fn draw(bencher: Bencher<'_, '_>, case: &Case) {
    with_view(case.steps, case.selector, |index, view| {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        bencher.counter(ItemsCount::new(DRAWS)).bench_local(|| {
            for _ in 0..DRAWS {
                divan::black_box(index.draw(view, &mut rng));
            }
        });
    });
}

#[divan::bench(args = SIZES)]
fn update_priorities(bencher: Bencher<'_, '_>, steps: u64) {
    with_view(
        steps,
        Selector::Prioritized { exponent: 0.6 },
        |index, view| {
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            bencher
                .counter(ItemsCount::new(UPDATES))
                .with_inputs(|| -> Vec<_> {
                    (0..UPDATES)
                        .map(|_| PriorityUpdate {
                            episode_id: rng.random_range(0..episodes(steps)),
                            start_step: rng.random_range(0..=EPISODE_STEPS - LENGTH),
                            priority: rng.random_range(0.01..10.0),
                        })
                        .collect()
                })
                .bench_local_values(|updates| {
                    let counts = index.update_priorities(view, &updates);
                    assert_eq!(counts.ignored, 0);
                });
        },
    );
}

/// Insertion at capacity: as many steps go as come. Counted in steps.
#[divan::bench(args = cases().filter(|case| case.steps == SIZES[0]))]
fn insert_and_evict(bencher: Bencher<'_, '_>, case: &Case) {
    let mut index = fill(case.steps, Some(case.selector));
    let mut episode = episodes(case.steps);
    let mut offset = u64::MAX / 2;
    bencher
        .counter(ItemsCount::new(ACTORS * u64::from(EPISODE_STEPS)))
        .bench_local(|| {
            insert_episodes(&mut index, &mut offset, episode);
            episode += ACTORS;
            index.evict(Capacity::steps(case.steps))
        });
}

fn main() {
    let none = [("no table", None)];
    let each = SELECTORS.map(|(name, selector)| (name, Some(selector)));
    for steps in SIZES {
        for (name, selector) in none.into_iter().chain(each) {
            let before = ALLOCATED.load(Relaxed);
            let index = fill(steps, selector);
            let bytes = ALLOCATED.load(Relaxed) - before;
            println!(
                "{:>3}M steps, {name:<12} {:.2} bytes per step",
                steps / 1_000_000,
                bytes as f64 / index.stats().steps as f64
            );
        }
    }
    divan::main();
}
