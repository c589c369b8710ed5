//! All chunks in the order of the log, the ones that went as gaps until the front reaches them.

use std::collections::VecDeque;

use super::IndexedChunk;
use crate::selector::Span;

/// Not a run: the chunk went.
const GONE: u32 = u32::MAX;

/// A chunk and where it belongs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    pub(super) chunk: IndexedChunk,
    /// Number of its first step, counted over all insertions.
    first_number: u64,
    run: u32,
}

impl Entry {
    pub(super) fn run(&self) -> Option<u32> {
        (self.run != GONE).then_some(self.run)
    }
}

/// Chunks by ordinal: their number, counted over all insertions.
#[derive(Debug, Default)]
pub(super) struct Chunks {
    entries: VecDeque<Entry>,
    /// Ordinal of the front.
    first: u64,
    /// Number of the next step.
    next_number: u64,
}

impl Chunks {
    /// Ordinal of the front and the number of its first step: where a new selection begins.
    pub(super) fn front(&self) -> (u64, u64) {
        let number = self.entries.front().map(|entry| entry.first_number);
        (self.first, number.unwrap_or(self.next_number))
    }

    pub(super) fn ordinals(&self) -> std::ops::Range<u64> {
        self.first..self.first + self.entries.len() as u64
    }

    pub(super) fn push(&mut self, chunk: IndexedChunk, run: u32) -> u64 {
        let ordinal = self.ordinals().end;
        self.entries.push_back(Entry {
            chunk,
            first_number: self.next_number,
            run,
        });
        self.next_number += u64::from(chunk.steps);
        ordinal
    }

    /// The entry with an ordinal that is in [`Chunks::ordinals`].
    pub(super) fn get(&self, ordinal: u64) -> &Entry {
        &self.entries[(ordinal - self.first) as usize]
    }

    pub(super) fn span(&self, ordinal: u64) -> Span {
        let entry = self.get(ordinal);
        Span {
            ordinal,
            steps: entry.first_number..entry.first_number + u64::from(entry.chunk.steps),
        }
    }

    pub(super) fn set_run(&mut self, ordinal: u64, run: Option<u32>) {
        self.entries[(ordinal - self.first) as usize].run = run.unwrap_or(GONE);
    }

    /// The run of the oldest chunk; frees what went before it.
    pub(super) fn oldest_run(&mut self) -> Option<u32> {
        while let Some(front) = self.entries.front() {
            if let Some(run) = front.run() {
                return Some(run);
            }
            self.entries.pop_front();
            self.first += 1;
        }
        None
    }

    /// The chunk at a place in the log.
    pub(super) fn at_place(&self, segment: u64, offset: u64) -> Option<u64> {
        let at = self
            .entries
            .binary_search_by_key(&(segment, offset), |entry| {
                (entry.chunk.segment, entry.chunk.offset)
            });
        at.ok().map(|at| self.first + at as u64)
    }

    /// The chunk that holds a step, by the step's number, which is held. Looks first where it would be if all
    /// chunks had the same length, and from there in strides that double.
    pub(super) fn with_step(&self, number: u64) -> u64 {
        let (first, front) = self.front();
        let len = self.entries.len();
        let share = (number - front) as u128 * len as u128;
        let guess = (share / u128::from(self.next_number - front)) as usize;
        let is_behind = |at: usize| self.entries[at].first_number > number;
        let (mut low, mut high, mut stride) = (guess, guess + 1, 1);
        while low > 0 && is_behind(low) {
            high = low;
            low = low.saturating_sub(stride);
            stride *= 2;
        }
        while high < len && !is_behind(high) {
            low = high;
            high = (high + stride).min(len);
            stride *= 2;
        }
        while high - low > 1 {
            let middle = low + (high - low) / 2;
            if is_behind(middle) {
                high = middle;
            } else {
                low = middle;
            }
        }
        first + low as u64
    }
}
