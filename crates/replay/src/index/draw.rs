//! Drawing from views, and what the learner says of the sequences it drew.

use isodream_core::EpisodeId;
use rand_chacha::ChaCha8Rng;

use super::{Index, IndexedChunk, ViewHandle};
use crate::selector::Target;

/// A drawn sequence of contiguous steps of one episode.
#[derive(Debug, Clone, PartialEq)]
pub struct Sequence {
    /// The episode.
    pub episode_id: EpisodeId,
    /// Index within the episode of the first step.
    pub start_step: u32,
    /// Probability of this draw among all that could have been made.
    pub probability: f64,
    /// The chunks that cover the sequence, in order.
    pub chunks: Vec<IndexedChunk>,
    /// Steps of the first chunk that precede the sequence.
    pub offset: u32,
}

/// The priority of a sequence, named by where it starts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PriorityUpdate {
    /// The episode.
    pub episode_id: EpisodeId,
    /// Index within the episode of the first step.
    pub start_step: u32,
    /// 0 or greater, and finite.
    pub priority: f32,
}

/// What became of priority updates.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PriorityCounts {
    /// Updates that took effect.
    pub applied: u64,
    /// Updates of sequences that are not held (any more).
    pub ignored: u64,
}

impl std::ops::AddAssign for PriorityCounts {
    fn add_assign(&mut self, other: Self) {
        self.applied += other.applied;
        self.ignored += other.ignored;
    }
}

impl Index {
    /// Whether [`Index::draw`] would find a sequence.
    pub fn can_draw(&self, view: &ViewHandle) -> bool {
        let mut views = self.views.iter();
        views.any(|held| held.id == view.id && held.selection.can_draw())
    }

    /// Draws a sequence; none where the table has none to give.
    pub fn draw(&mut self, view: &ViewHandle, rng: &mut ChaCha8Rng) -> Option<Sequence> {
        let held = self.views.iter_mut().find(|held| held.id == view.id)?;
        let pick = held.selection.draw(rng)?;
        let start_at_end = |end: u32| end + 1 - view.length;
        let (id, start_step) = match pick.target {
            Target::Run { run, start } => (run, self.runs.get(run)?.first_step + start),
            Target::Chunk { ordinal, back } => {
                let entry = self.chunks.get(ordinal);
                let end = entry.chunk.first_step + entry.chunk.steps - back;
                (entry.run()?, start_at_end(end))
            }
            Target::Step { number } => {
                let ordinal = self.chunks.with_step(number);
                let entry = self.chunks.get(ordinal);
                let inside = number - self.chunks.span(ordinal).steps.start;
                let end = entry.chunk.first_step + inside as u32;
                (entry.run()?, start_at_end(end))
            }
        };
        self.sequence(id, start_step, view.length, pick.probability)
    }

    /// Sets priorities in a view. Those of sequences that are not held are ignored, and so are all where the
    /// table does not draw by priority.
    pub fn update_priorities(
        &mut self,
        view: &ViewHandle,
        updates: &[PriorityUpdate],
    ) -> PriorityCounts {
        // Two passes, because the processor waits for memory in each, and short loops wait for several at once.
        let numbers: Vec<_> = updates
            .iter()
            .map(|update| self.last_step(update.episode_id, update.start_step, view.length))
            .collect();
        let mut applied = 0;
        if let Some(held) = self.views.iter_mut().find(|held| held.id == view.id) {
            for (number, update) in numbers.into_iter().zip(updates) {
                let set = |number| held.selection.set_priority(number, update.priority);
                applied += u64::from(number.is_some_and(set));
            }
        }
        PriorityCounts {
            applied,
            ignored: updates.len() as u64 - applied,
        }
    }

    /// Number of the last step of a sequence that is held.
    fn last_step(&self, episode_id: EpisodeId, start_step: u32, length: u32) -> Option<u64> {
        let run = self.runs.get(self.run_before(episode_id, start_step)?)?;
        let end = start_step.checked_add(length - 1)?;
        if end >= run.end_step() {
            return None;
        }
        let ordinal = run.chunks[run.chunk_with(end, &self.chunks)];
        let inside = end - self.chunks.get(ordinal).chunk.first_step;
        Some(self.chunks.span(ordinal).steps.start + u64::from(inside))
    }

    /// The sequence of `length` steps from `start_step` on in a run that holds it.
    fn sequence(
        &self,
        id: u32,
        start_step: u32,
        length: u32,
        probability: f64,
    ) -> Option<Sequence> {
        let run = self.runs.get(id)?;
        let first = run.chunk_with(start_step, &self.chunks);
        let chunks: Vec<_> = run.chunks[first..]
            .iter()
            .map(|ordinal| self.chunks.get(*ordinal).chunk)
            .take_while(|chunk| chunk.first_step < start_step + length)
            .collect();
        Some(Sequence {
            episode_id: run.episode_id,
            start_step,
            probability,
            offset: start_step - chunks.first()?.first_step,
            chunks,
        })
    }
}
