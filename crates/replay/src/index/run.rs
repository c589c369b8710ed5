//! Runs: contiguous chunks of one episode.

use isodream_core::EpisodeId;

use super::chunks::Chunks;

/// An episode, or what damage left of it on one side.
#[derive(Debug)]
pub(super) struct Run {
    pub(super) episode_id: EpisodeId,
    pub(super) first_step: u32,
    /// Steps.
    pub(super) len: u32,
    pub(super) ended: bool,
    /// Ordinals, in order.
    pub(super) chunks: Vec<u64>,
}

impl Run {
    pub(super) fn new(episode_id: EpisodeId, first_step: u32) -> Self {
        Self {
            episode_id,
            first_step,
            len: 0,
            ended: false,
            chunks: Vec::new(),
        }
    }

    pub(super) fn end_step(&self) -> u32 {
        self.first_step + self.len
    }

    /// Which of the run's chunks holds `step`, a step of the run.
    pub(super) fn chunk_with(&self, step: u32, chunks: &Chunks) -> usize {
        let chunk_at = |at: usize| &chunks.get(self.chunks[at]).chunk;
        // As a rule all chunks are as long as the first.
        let guess = ((step - self.first_step) / chunk_at(0).steps) as usize;
        if guess < self.chunks.len() {
            let chunk = chunk_at(guess);
            if (chunk.first_step..chunk.first_step + chunk.steps).contains(&step) {
                return guess;
            }
        }
        self.chunks
            .partition_point(|ordinal| chunks.get(*ordinal).chunk.first_step <= step)
            - 1
    }
}

/// Runs by a number that is used again once its run is gone.
#[derive(Debug, Default)]
pub(super) struct Runs {
    slots: Vec<Option<Run>>,
    free: Vec<u32>,
}

impl Runs {
    pub(super) fn len(&self) -> usize {
        self.slots.len() - self.free.len()
    }

    pub(super) fn add(&mut self, run: Run) -> u32 {
        if let Some(id) = self.free.pop() {
            self.slots[id as usize] = Some(run);
            return id;
        }
        self.slots.push(Some(run));
        self.slots.len() as u32 - 1
    }

    pub(super) fn get(&self, id: u32) -> Option<&Run> {
        self.slots.get(id as usize)?.as_ref()
    }

    pub(super) fn get_mut(&mut self, id: u32) -> Option<&mut Run> {
        self.slots.get_mut(id as usize)?.as_mut()
    }

    pub(super) fn take(&mut self, id: u32) -> Option<Run> {
        let run = self.slots.get_mut(id as usize)?.take()?;
        self.free.push(id);
        Some(run)
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (u32, &Run)> {
        let slots = (0..).zip(&self.slots);
        slots.filter_map(|(id, run)| Some((id, run.as_ref()?)))
    }
}
