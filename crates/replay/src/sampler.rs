//! Drawing sequences.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{SequenceRef, Store};

/// Draws sequences as the paper does: uniform over the episodes that hold at least one sequence, unfinished
/// ones included, then uniform over the start steps. Only durable steps are drawn.
///
/// The same seed draws the same sequences from a store of the same content.
#[derive(Debug, Clone)]
pub struct Sampler {
    rng: ChaCha8Rng,
    sequence_length: u32,
}

impl Sampler {
    /// A sampler of sequences of `sequence_length` steps.
    pub fn new(seed: u64, sequence_length: u32) -> Self {
        Self {
            rng: ChaCha8Rng::seed_from_u64(seed),
            sequence_length,
        }
    }

    /// Steps per sequence.
    pub fn sequence_length(&self) -> u32 {
        self.sequence_length
    }

    /// Draws a sequence; none where no episode is long enough.
    pub fn draw(&mut self, store: &Store) -> Option<SequenceRef> {
        store.sample(self.sequence_length, &mut self.rng)
    }
}
