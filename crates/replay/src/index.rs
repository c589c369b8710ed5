//! Which steps are held, and where: episodes as runs of contiguous chunks.
//!
//! An episode is one run unless damage took a chunk out of its middle: then it is one run on either side.

use std::collections::{BTreeMap, HashMap, VecDeque};

use isodream_core::EpisodeId;
use rand::RngExt;

use crate::segment::ChunkRef;

/// What an index holds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct IndexStats {
    /// Steps.
    pub steps: u64,
    /// Episodes, unfinished ones included.
    pub episodes: u64,
    /// Bytes of the records.
    pub bytes: u64,
}

/// A sequence of contiguous steps of one episode, as places on disk.
#[derive(Debug, Clone)]
pub struct SequenceRef {
    /// The episode.
    pub episode_id: EpisodeId,
    /// The chunks that cover the sequence, in order.
    pub chunks: Vec<ChunkRef>,
    /// Steps of the first chunk that precede the sequence.
    pub offset: u32,
}

#[derive(Debug)]
struct Run {
    episode_id: EpisodeId,
    chunks: VecDeque<ChunkRef>,
    len: u32,
    ended: bool,
}

impl Run {
    fn end_step(&self) -> Option<u32> {
        self.chunks
            .back()
            .map(|chunk| chunk.first_step + chunk.steps)
    }

    fn first_step(&self) -> u32 {
        self.chunks.front().map_or(0, |chunk| chunk.first_step)
    }

    /// The chunks that cover `length` steps from `start` steps into the run.
    fn cover(&self, start: u32, length: u32) -> SequenceRef {
        let from = self.first_step() + start;
        let first = self
            .chunks
            .partition_point(|chunk| chunk.first_step + chunk.steps <= from);
        let chunks: Vec<_> = self
            .chunks
            .range(first..)
            .take_while(|chunk| chunk.first_step - from.min(chunk.first_step) < length)
            .cloned()
            .collect();
        let offset = chunks.first().map_or(0, |chunk| from - chunk.first_step);
        SequenceRef {
            episode_id: self.episode_id,
            chunks,
            offset,
        }
    }
}

/// Runs in order of their first chunk, oldest first.
#[derive(Debug, Default)]
pub(crate) struct Index {
    runs: BTreeMap<u64, Run>,
    next_run: u64,
    /// The run that an episode's next chunk continues.
    growing: HashMap<EpisodeId, u64>,
    /// Chunks that each segment still holds.
    live: HashMap<u64, u64>,
    steps: u64,
    bytes: u64,
}

impl Index {
    pub(crate) fn insert(&mut self, episode_id: EpisodeId, ends_episode: bool, chunk: ChunkRef) {
        self.steps += u64::from(chunk.steps);
        self.bytes += chunk.stored_bytes();
        *self.live.entry(chunk.segment.number).or_default() += 1;
        let continued = self.growing.get(&episode_id).copied().filter(|run| {
            let run = self.runs.get(run);
            run.is_some_and(|run| !run.ended && run.end_step() == Some(chunk.first_step))
        });
        let id = continued.unwrap_or_else(|| self.add_run(episode_id));
        if let Some(run) = self.runs.get_mut(&id) {
            run.len += chunk.steps;
            run.ended = ends_episode;
            run.chunks.push_back(chunk);
        }
        if ends_episode {
            self.growing.remove(&episode_id);
        } else {
            self.growing.insert(episode_id, id);
        }
    }

    fn add_run(&mut self, episode_id: EpisodeId) -> u64 {
        let id = self.next_run;
        self.next_run += 1;
        self.runs.insert(
            id,
            Run {
                episode_id,
                chunks: VecDeque::new(),
                len: 0,
                ended: false,
            },
        );
        id
    }

    /// Drops the oldest episodes until at most `capacity_steps` are held; the newest always stays.
    /// Returns how many went.
    pub(crate) fn evict(&mut self, capacity_steps: u64) -> u64 {
        let mut evicted = 0;
        while self.steps > capacity_steps && self.runs.len() > 1 {
            let Some((id, run)) = self.runs.pop_first() else {
                break;
            };
            if self.growing.get(&run.episode_id) == Some(&id) {
                self.growing.remove(&run.episode_id);
            }
            for chunk in &run.chunks {
                self.forget(chunk);
            }
            evicted += 1;
        }
        evicted
    }

    /// Drops a chunk that cannot be read. False where it is not held (any more).
    pub(crate) fn remove(&mut self, chunk: &ChunkRef) -> bool {
        let found = self.runs.iter().find_map(|(&id, run)| {
            let at = run.chunks.iter().position(|held| held.same_place(chunk))?;
            Some((id, at))
        });
        let Some((id, at)) = found else { return false };
        let Some(mut run) = self.runs.remove(&id) else {
            return false;
        };
        let mut behind = run.chunks.split_off(at);
        if let Some(removed) = behind.pop_front() {
            self.forget(&removed);
        }
        let was_growing = self.growing.get(&run.episode_id) == Some(&id);
        if was_growing {
            self.growing.remove(&run.episode_id);
        }
        if !behind.is_empty() {
            let id = self.add_run(run.episode_id);
            if let Some(rest) = self.runs.get_mut(&id) {
                rest.len = behind.iter().map(|chunk| chunk.steps).sum();
                rest.ended = run.ended;
                rest.chunks = behind;
            }
            if was_growing {
                self.growing.insert(run.episode_id, id);
            }
        }
        if !run.chunks.is_empty() {
            run.len = run.chunks.iter().map(|chunk| chunk.steps).sum();
            self.runs.insert(id, run);
        }
        true
    }

    fn forget(&mut self, chunk: &ChunkRef) {
        self.steps -= u64::from(chunk.steps);
        self.bytes -= chunk.stored_bytes();
        if let Some(count) = self.live.get_mut(&chunk.segment.number) {
            *count -= 1;
            if *count == 0 {
                self.live.remove(&chunk.segment.number);
            }
        }
    }

    /// Whether some held chunk lies in `segment`.
    pub(crate) fn is_live(&self, segment: u64) -> bool {
        self.live.contains_key(&segment)
    }

    /// Whether some episode holds `length` steps.
    pub(crate) fn can_sample(&self, length: u32) -> bool {
        length > 0 && self.runs.values().any(|run| run.len >= length)
    }

    /// Uniform over the episodes that hold `length` steps, then uniform over the start steps.
    pub(crate) fn sample(&self, length: u32, rng: &mut impl RngExt) -> Option<SequenceRef> {
        let long_enough = || self.runs.values().filter(|run| run.len >= length);
        let count = long_enough().count();
        if count == 0 || length == 0 {
            return None;
        }
        // u64, not usize: a seed draws the same on every platform.
        let chosen = rng.random_range(0..count as u64);
        let run = long_enough().nth(chosen as usize)?;
        let start = rng.random_range(0..=run.len - length);
        Some(run.cover(start, length))
    }

    pub(crate) fn stats(&self) -> IndexStats {
        IndexStats {
            steps: self.steps,
            episodes: self.runs.len() as u64,
            bytes: self.bytes,
        }
    }
}
