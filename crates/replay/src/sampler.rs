//! Drawing sequences from a store.

use isodream_core::EpisodeId;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::index::{PriorityCounts, PriorityUpdate, ViewHandle};
use crate::{ChunkRef, ReplayError, Selector, Store, Table};

/// Updates made without letting anybody else at the store.
const UPDATE_GROUP: usize = 256;

/// A sequence of contiguous steps of one episode, as places on disk.
#[derive(Debug, Clone)]
pub struct SequenceRef {
    /// The episode.
    pub episode_id: EpisodeId,
    /// Index within the episode of the sequence's first step.
    pub start_step: u32,
    /// Probability of this draw among all that could have been made.
    pub probability: f64,
    /// The chunks that cover the sequence, in order.
    pub chunks: Vec<ChunkRef>,
    /// Steps of the first chunk that precede the sequence.
    pub offset: u32,
}

/// Draws sequences from a table, see [`Store::sampler`]. Only durable steps are drawn.
#[derive(Debug, Clone)]
pub struct Sampler {
    store: Store,
    table: Table,
    view: ViewHandle,
    rng: ChaCha8Rng,
}

impl Sampler {
    pub(crate) fn new(store: Store, table: Table, view: ViewHandle, seed: u64) -> Self {
        Self {
            store,
            table,
            view,
            rng: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    /// Steps per sequence.
    pub fn sequence_length(&self) -> u32 {
        self.view.sequence_length()
    }

    /// Whether [`Sampler::draw`] would find a sequence.
    pub fn can_draw(&self) -> bool {
        self.store.lock().index.can_draw(&self.view)
    }

    /// Draws a sequence; none where the table has none to give.
    pub fn draw(&mut self) -> Option<SequenceRef> {
        let mut held = self.store.lock();
        let drawn = held.index.draw(&self.view, &mut self.rng)?;
        let chunks = drawn.chunks.iter().map(|chunk| held.place(chunk));
        Some(SequenceRef {
            episode_id: drawn.episode_id,
            start_step: drawn.start_step,
            probability: drawn.probability,
            chunks: chunks.collect::<Option<_>>()?,
            offset: drawn.offset,
        })
    }

    /// Sets priorities in the table. Those of sequences that are not held (any more) are ignored and counted.
    ///
    /// # Errors
    /// Nothing was changed: [`ReplayError::NoPriorities`] where the table does not draw by priority,
    /// [`ReplayError::InvalidPriority`] where one is negative or no number.
    pub fn update_priorities(
        &self,
        updates: &[PriorityUpdate],
    ) -> Result<PriorityCounts, ReplayError> {
        if !matches!(self.table.selector, Selector::Prioritized { .. }) {
            return Err(ReplayError::NoPriorities {
                table: self.table.name.clone(),
            });
        }
        let in_range = |priority: f32| priority.is_finite() && priority >= 0.0;
        if let Some(update) = updates.iter().find(|update| !in_range(update.priority)) {
            return Err(ReplayError::InvalidPriority {
                episode_id: update.episode_id,
                start_step: update.start_step,
                priority: update.priority,
            });
        }
        let mut counts = PriorityCounts::default();
        for group in updates.chunks(UPDATE_GROUP) {
            let mut held = self.store.lock();
            let group = held.index.update_priorities(&self.view, group);
            held.priorities += group;
            counts += group;
        }
        Ok(counts)
    }
}
