//! Runs that hold at least one sequence, drawn uniformly or in proportion to their start steps, in constant
//! expected time.
//!
//! Runs are sorted into classes by the power of two of their number of start steps. A proportional draw picks
//! a class by its sum, and in it a run and a start below twice the class's least number until the run has
//! that start: at least every other attempt does.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

const CLASSES: usize = u32::BITS as usize;

/// A set of runs with their number of start steps.
#[derive(Debug)]
pub(crate) struct RunSet {
    /// By run.
    slots: Vec<Slot>,
    classes: [Class; CLASSES],
    runs: u64,
    starts: u64,
}

#[derive(Debug, Clone, Copy, Default)]
struct Slot {
    /// 0 where the run is not in the set.
    starts: u32,
    /// Where its class lists it.
    at: u32,
}

#[derive(Debug, Default)]
struct Class {
    runs: Vec<u32>,
    starts: u64,
}

fn class_of(starts: u32) -> usize {
    starts.ilog2() as usize
}

impl RunSet {
    /// An empty set.
    pub(crate) fn new() -> Self {
        Self {
            slots: Vec::new(),
            classes: std::array::from_fn(|_| Class::default()),
            runs: 0,
            starts: 0,
        }
    }

    /// Start steps of all runs.
    pub(crate) fn starts(&self) -> u64 {
        self.starts
    }

    /// Runs in the set.
    pub(crate) fn runs(&self) -> u64 {
        self.runs
    }

    /// Sets a run's number of start steps; 0 takes it out.
    pub(crate) fn set(&mut self, run: u32, starts: u32) {
        if run as usize >= self.slots.len() {
            self.slots.resize(run as usize + 1, Slot::default());
        }
        let slot = self.slots[run as usize];
        if slot.starts > 0 {
            let class = &mut self.classes[class_of(slot.starts)];
            class.starts -= u64::from(slot.starts);
            if starts > 0 && class_of(starts) == class_of(slot.starts) {
                class.starts += u64::from(starts);
                self.slots[run as usize].starts = starts;
                self.starts = self.starts - u64::from(slot.starts) + u64::from(starts);
                return;
            }
            class.runs.swap_remove(slot.at as usize);
            if let Some(&moved) = class.runs.get(slot.at as usize) {
                self.slots[moved as usize].at = slot.at;
            }
            self.runs -= 1;
            self.starts -= u64::from(slot.starts);
        }
        let mut at = 0;
        if starts > 0 {
            let class = &mut self.classes[class_of(starts)];
            at = class.runs.len() as u32;
            class.runs.push(run);
            class.starts += u64::from(starts);
            self.runs += 1;
            self.starts += u64::from(starts);
        }
        self.slots[run as usize] = Slot { starts, at };
    }

    /// A run, each with the same probability, and its number of start steps.
    pub(crate) fn draw_run(&self, rng: &mut ChaCha8Rng) -> Option<(u32, u32)> {
        if self.runs == 0 {
            return None;
        }
        let mut rank = rng.random_range(0..self.runs);
        for class in &self.classes {
            if let Some(&run) = class.runs.get(rank as usize) {
                return Some((run, self.slots[run as usize].starts));
            }
            rank -= class.runs.len() as u64;
        }
        None
    }

    /// A run and one of its start steps, each start step of all runs with the same probability.
    pub(crate) fn draw_start(&self, rng: &mut ChaCha8Rng) -> Option<(u32, u32)> {
        if self.starts == 0 {
            return None;
        }
        let mut rank = rng.random_range(0..self.starts);
        let at = self.classes.iter().position(|class| {
            let found = rank < class.starts;
            if !found {
                rank -= class.starts;
            }
            found
        })?;
        let runs = &self.classes[at].runs;
        loop {
            // u64, not usize: a seed draws the same on every platform.
            let run = runs[rng.random_range(0..runs.len() as u64) as usize];
            let start = rng.random_range(0..2_u64 << at) as u32;
            if start < self.slots[run as usize].starts {
                return Some((run, start));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::SeedableRng;

    use super::*;

    proptest! {
        #[test]
        fn counts_follow_the_changes_and_only_members_are_drawn(
            changes in prop::collection::vec((0..12_u32, prop_oneof![Just(0), 1..40_u32]), 1..100),
            seed: u64,
        ) {
            let mut set = RunSet::new();
            let mut plain = [0_u32; 12];
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for (run, starts) in changes {
                set.set(run, starts);
                plain[run as usize] = starts;
                let members = plain.iter().filter(|starts| **starts > 0).count() as u64;
                prop_assert_eq!(set.runs(), members);
                prop_assert_eq!(set.starts(), plain.iter().copied().map(u64::from).sum::<u64>());
                match (set.draw_run(&mut rng), set.draw_start(&mut rng)) {
                    (Some((run, starts)), Some((other, start))) => {
                        prop_assert_eq!(plain[run as usize], starts);
                        prop_assert!(starts > 0);
                        prop_assert!(start < plain[other as usize]);
                    }
                    (None, None) => prop_assert_eq!(members, 0),
                    drawn => prop_assert!(false, "{:?}", drawn),
                }
            }
        }
    }
}
