//! A moving window of weights that is drawn from in proportion to them.
//!
//! Weights are integers, so sums are exact however long they are kept up to date, and a draw is the same on
//! every platform. A weight takes 4 bytes and its share of the sums above it half a byte.

use std::collections::VecDeque;
use std::ops::Range;

/// Children per sum, as a power of two: one cache line of weights.
const FANOUT_BITS: u32 = 4;
const FANOUT: u64 = 1 << FANOUT_BITS;
/// Levels of sums. The uppermost is searched from end to end; one of its sums covers 16.8 million weights.
const LEVELS: usize = 6;

/// Weights numbered without gaps, appended at the end and forgotten at the front.
#[derive(Debug)]
pub(crate) struct SumTree {
    weights: VecDeque<u32>,
    /// Number of the first weight held, a multiple of the fanout.
    first: u64,
    levels: [Level; LEVELS],
    total: u64,
}

/// Sums of aligned groups of the level below.
#[derive(Debug, Default)]
struct Level {
    /// Number of the first group held.
    first: u64,
    sums: VecDeque<u64>,
}

fn group_of(number: u64, level: usize) -> u64 {
    number >> (FANOUT_BITS * (level as u32 + 1))
}

/// The numbers from the beginning of `number`'s group up to it.
fn before_in_group(number: u64) -> Range<u64> {
    number & !(FANOUT - 1)..number
}

impl SumTree {
    /// An empty tree whose first weight has the number `first`.
    pub(crate) fn new(first: u64) -> Self {
        let aligned = before_in_group(first).start;
        let mut tree = Self {
            weights: VecDeque::new(),
            first: aligned,
            levels: std::array::from_fn(|level| Level {
                first: group_of(aligned, level),
                sums: VecDeque::new(),
            }),
            total: 0,
        };
        for _ in aligned..first {
            tree.push(0);
        }
        tree
    }

    /// Sum of all weights.
    pub(crate) fn total(&self) -> u64 {
        self.total
    }

    /// Number of the next weight.
    pub(crate) fn end(&self) -> u64 {
        self.first + self.weights.len() as u64
    }

    /// The weight `number`, 0 where it is not held.
    pub(crate) fn get(&self, number: u64) -> u32 {
        let at = number.checked_sub(self.first);
        at.and_then(|at| self.weights.get(at as usize))
            .copied()
            .unwrap_or(0)
    }

    /// Appends a weight.
    pub(crate) fn push(&mut self, weight: u32) {
        let number = self.end();
        self.weights.push_back(weight);
        for (at, level) in self.levels.iter_mut().enumerate() {
            let group = (group_of(number, at) - level.first) as usize;
            if group == level.sums.len() {
                level.sums.push_back(0);
            }
            level.sums[group] += u64::from(weight);
        }
        self.total += u64::from(weight);
    }

    /// Changes a weight. False where it is not held.
    pub(crate) fn set(&mut self, number: u64, weight: u32) -> bool {
        let Some(held) = number
            .checked_sub(self.first)
            .and_then(|at| self.weights.get_mut(at as usize))
        else {
            return false;
        };
        let before = std::mem::replace(held, weight);
        self.add(number, u64::from(weight).wrapping_sub(u64::from(before)));
        true
    }

    /// Sets the weights of `numbers`, all of them held, to 0.
    pub(crate) fn clear(&mut self, numbers: Range<u64>) {
        let mut removed = 0;
        for number in numbers.clone() {
            let held = &mut self.weights[(number - self.first) as usize];
            removed += u64::from(std::mem::take(held));
            // The sums change once per group.
            if (number + 1) % FANOUT == 0 || number + 1 == numbers.end {
                self.add(number, 0_u64.wrapping_sub(removed));
                removed = 0;
            }
        }
    }

    /// Adds to all sums above `number`, in arithmetic modulo 2^64.
    fn add(&mut self, number: u64, delta: u64) {
        if delta == 0 {
            return;
        }
        for (at, level) in self.levels.iter_mut().enumerate() {
            let sum = &mut level.sums[(group_of(number, at) - level.first) as usize];
            *sum = sum.wrapping_add(delta);
        }
        self.total = self.total.wrapping_add(delta);
    }

    /// Frees the weights before `number`, which must be 0.
    pub(crate) fn forget_before(&mut self, number: u64) {
        let keep = before_in_group(number.min(self.end()))
            .start
            .max(self.first);
        let gone = self.weights.drain(..(keep - self.first) as usize);
        debug_assert!(gone.into_iter().all(|weight| weight == 0));
        self.first = keep;
        for (at, level) in self.levels.iter_mut().enumerate() {
            let keep = group_of(keep, at);
            let gone = ((keep - level.first) as usize).min(level.sums.len());
            level.sums.drain(..gone);
            level.first = keep;
        }
    }

    /// Sum of the weights before `number`.
    pub(crate) fn sum_before(&self, number: u64) -> u64 {
        let number = number.clamp(self.first, self.end());
        let mut sum = self
            .weights_in(before_in_group(number))
            .map(u64::from)
            .sum::<u64>();
        for (at, level) in self.levels.iter().enumerate() {
            let group = group_of(number, at);
            let siblings = if at + 1 == LEVELS {
                0..group
            } else {
                before_in_group(group)
            };
            sum += level.sums_in(siblings).sum::<u64>();
        }
        sum
    }

    /// The weight in which `rank` falls when all weights are laid end to end, and how far inside it.
    /// `rank` must be less than the total.
    pub(crate) fn find(&self, mut rank: u64) -> (u64, u32) {
        let top = &self.levels[LEVELS - 1];
        let mut group = descend(top.sums.iter().copied(), top.first, &mut rank);
        for level in self.levels[..LEVELS - 1].iter().rev() {
            let children = group * FANOUT..(group + 1) * FANOUT;
            let first = children.start.max(level.first);
            group = descend(level.sums_in(children), first, &mut rank);
        }
        let children = group * FANOUT..(group + 1) * FANOUT;
        let first = children.start.max(self.first);
        let weights = self.weights_in(children).map(u64::from);
        let number = descend(weights, first, &mut rank);
        (number, rank as u32)
    }

    fn weights_in(&self, numbers: Range<u64>) -> impl Iterator<Item = u32> {
        let held = held(numbers, self.first, self.weights.len());
        self.weights.range(held).copied()
    }
}

impl Level {
    fn sums_in(&self, groups: Range<u64>) -> impl Iterator<Item = u64> {
        let held = held(groups, self.first, self.sums.len());
        self.sums.range(held).copied()
    }
}

/// Where those of `numbers` lie that a queue of `len` items from `first` on holds.
fn held(numbers: Range<u64>, first: u64, len: usize) -> Range<usize> {
    let end = numbers.end.saturating_sub(first).min(len as u64);
    let start = numbers.start.saturating_sub(first).min(end);
    start as usize..end as usize
}

/// The number of the item in which `rank` falls; what is before it goes off the rank.
fn descend(items: impl Iterator<Item = u64>, first: u64, rank: &mut u64) -> u64 {
    let mut number = first;
    for item in items {
        if *rank < item {
            break;
        }
        *rank -= item;
        number += 1;
    }
    number
}

#[cfg(test)]
#[path = "sum_tree_tests.rs"]
mod tests;
