//! Which steps are held, where they lie, and which sequences they make.
//!
//! An episode is one run of contiguous chunks unless damage took a chunk out of its middle: then it is one run
//! on either side. The index knows places in the log but no files, so that it can be measured without them.
//! Draws cost the same at any size, or grow with its logarithm, as [`crate::Selector`] says.

mod chunks;
mod draw;
mod run;
mod view;

use std::collections::BTreeMap;

use isodream_core::EpisodeId;

use self::chunks::Chunks;
use self::run::{Run, Runs};
use self::view::View;
use crate::{Capacity, Table};

pub use self::draw::{PriorityCounts, PriorityUpdate, Sequence};
pub use self::view::ViewHandle;

/// What an index holds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct IndexStats {
    /// Steps.
    pub steps: u64,
    /// Episodes, unfinished ones included; both sides of a damaged one count.
    pub episodes: u64,
    /// Bytes of the records.
    pub bytes: u64,
}

/// A chunk as the index knows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IndexedChunk {
    /// Number of its segment.
    pub segment: u64,
    /// Byte offset of its record in the segment.
    pub offset: u64,
    /// Bytes of its record.
    pub bytes: u32,
    /// Index within the episode of its first step.
    pub first_step: u32,
    /// Steps, at least 1.
    pub steps: u32,
}

/// Chunks in the order of the log, oldest first.
#[derive(Debug, Default)]
pub struct Index {
    chunks: Chunks,
    runs: Runs,
    /// Runs by episode and first step.
    episodes: BTreeMap<(EpisodeId, u32), u32>,
    /// Chunks that each segment still holds.
    live: BTreeMap<u64, u64>,
    views: Vec<View>,
    next_view: u64,
    steps: u64,
    bytes: u64,
}

impl Index {
    /// Adds the chunk at the end of the log. It continues the run that ends where it begins, or starts one.
    pub fn insert(&mut self, episode_id: EpisodeId, ends_episode: bool, chunk: IndexedChunk) {
        self.steps += u64::from(chunk.steps);
        self.bytes += u64::from(chunk.bytes);
        *self.live.entry(chunk.segment).or_default() += 1;
        let id = self
            .growing_run(episode_id, chunk.first_step)
            .unwrap_or_else(|| self.add_run(Run::new(episode_id, chunk.first_step)));
        let ordinal = self.chunks.push(chunk, id);
        let Some(run) = self.runs.get_mut(id) else {
            return;
        };
        run.chunks.push(ordinal);
        run.len += chunk.steps;
        run.ended = ends_episode;
        if ends_episode {
            run.chunks.shrink_to_fit();
        }
        for view in &mut self.views {
            view.chunk_changed(ordinal, Some(run), &self.chunks);
            view.run_changed(id, run.len);
        }
    }

    /// Drops the oldest episodes until `capacity` is kept; the newest always stays. Returns how many went.
    pub fn evict(&mut self, capacity: Capacity) -> u64 {
        let mut evicted = 0;
        while capacity.is_exceeded(self.steps, self.bytes) && self.runs.len() > 1 {
            let Some(run) = self
                .chunks
                .oldest_run()
                .and_then(|oldest| self.take_run(oldest))
            else {
                break;
            };
            for ordinal in run.chunks {
                self.drop_chunk(ordinal);
            }
            evicted += 1;
        }
        self.forget();
        evicted
    }

    /// Drops the chunk whose record begins at `offset` of `segment`; the rest of its run stays, split where it
    /// was. False where it is not held (any more).
    pub fn remove(&mut self, segment: u64, offset: u64) -> bool {
        let Some(removed) = self.chunks.at_place(segment, offset) else {
            return false;
        };
        let Some(mut front) = self
            .chunks
            .get(removed)
            .run()
            .and_then(|run| self.take_run(run))
        else {
            return false;
        };
        let at = front.chunks.partition_point(|ordinal| *ordinal < removed);
        let behind = front.chunks.split_off(at + 1);
        front.chunks.truncate(at);
        self.drop_chunk(removed);
        let gap = self.chunks.get(removed).chunk;
        let rest = Run {
            episode_id: front.episode_id,
            first_step: gap.first_step + gap.steps,
            len: front.end_step() - (gap.first_step + gap.steps),
            ended: front.ended,
            chunks: behind,
        };
        front.len = gap.first_step - front.first_step;
        // The steps that would follow are gone for good.
        front.ended = true;
        for part in [front, rest] {
            self.put_back(part);
        }
        self.forget();
        true
    }

    /// Whether some held chunk lies in `segment`.
    pub fn is_live(&self, segment: u64) -> bool {
        self.live.contains_key(&segment)
    }

    /// What is held.
    pub fn stats(&self) -> IndexStats {
        IndexStats {
            steps: self.steps,
            episodes: self.runs.len() as u64,
            bytes: self.bytes,
        }
    }

    /// The view of `table` with sequences of `length` steps, at least 1; made where there is none yet, which
    /// takes time in proportion to what is held. One that nobody uses stays until another is made of its
    /// table.
    ///
    /// # Panics
    /// Where `length` is 0.
    pub fn view(&mut self, table: &Table, length: u32) -> ViewHandle {
        assert!(length > 0, "a sequence has at least one step");
        let known = self
            .views
            .iter()
            .find(|view| view.table == *table && view.length == length);
        if let Some(view) = known {
            return view.handle();
        }
        self.views
            .retain(|view| view.is_used() || view.table.name != table.name);
        let id = self.next_view;
        self.next_view += 1;
        let view = View::new(id, table.clone(), length, &self.chunks, &self.runs);
        let handle = view.handle();
        self.views.push(view);
        handle
    }

    fn growing_run(&self, episode_id: EpisodeId, next_step: u32) -> Option<u32> {
        let id = self.run_before(episode_id, next_step)?;
        let run = self.runs.get(id)?;
        (!run.ended && run.end_step() == next_step).then_some(id)
    }

    /// The episode's run that begins last among those that begin at `step` or earlier.
    fn run_before(&self, episode_id: EpisodeId, step: u32) -> Option<u32> {
        let range = (episode_id, 0)..=(episode_id, step);
        self.episodes.range(range).next_back().map(|(_, id)| *id)
    }

    fn add_run(&mut self, run: Run) -> u32 {
        let key = (run.episode_id, run.first_step);
        let id = self.runs.add(run);
        self.episodes.insert(key, id);
        id
    }

    /// Takes a run out, its chunks not yet.
    fn take_run(&mut self, id: u32) -> Option<Run> {
        let run = self.runs.take(id)?;
        let key = (run.episode_id, run.first_step);
        // A run that begins at the same step may have replaced it there.
        if self.episodes.get(&key) == Some(&id) {
            self.episodes.remove(&key);
        }
        for view in &mut self.views {
            view.run_changed(id, 0);
        }
        Some(run)
    }

    /// Adds a run whose chunks are held already.
    fn put_back(&mut self, run: Run) {
        if run.chunks.is_empty() {
            return;
        }
        let id = self.add_run(run);
        let Some(run) = self.runs.get(id) else {
            return;
        };
        for ordinal in &run.chunks {
            self.chunks.set_run(*ordinal, Some(id));
            for view in &mut self.views {
                view.chunk_changed(*ordinal, Some(run), &self.chunks);
            }
        }
        for view in &mut self.views {
            view.run_changed(id, run.len);
        }
    }

    fn drop_chunk(&mut self, ordinal: u64) {
        self.chunks.set_run(ordinal, None);
        for view in &mut self.views {
            view.chunk_changed(ordinal, None, &self.chunks);
        }
        let chunk = self.chunks.get(ordinal).chunk;
        self.steps -= u64::from(chunk.steps);
        self.bytes -= u64::from(chunk.bytes);
        if let Some(count) = self.live.get_mut(&chunk.segment) {
            *count -= 1;
            if *count == 0 {
                self.live.remove(&chunk.segment);
            }
        }
    }

    /// Frees what lies before the oldest chunk.
    fn forget(&mut self) {
        self.chunks.oldest_run();
        let (ordinal, number) = self.chunks.front();
        for view in &mut self.views {
            view.selection.forget_before(ordinal, number);
        }
    }
}

#[cfg(test)]
#[path = "../index_tests.rs"]
mod tests;
