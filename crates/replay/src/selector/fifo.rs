//! First in, first out: each sequence once, in the order in which its last step arrived; whoever asks next gets
//! the next one. Sequences that were evicted before their turn are left out. After a restart of the store it
//! begins with the oldest sequence again.

use rand_chacha::ChaCha8Rng;

use super::sum_tree::SumTree;
use super::{Pick, Selection, Span, Target};

/// A place in the queue.
#[derive(Debug)]
pub(super) struct Fifo {
    /// Sequences that end in each chunk.
    ends: SumTree,
    /// The chunk whose turn it is.
    ordinal: u64,
    /// How many of its sequences are left; more than it holds where none was drawn yet.
    left: u32,
}

impl Fifo {
    pub(super) fn new(ordinal: u64) -> Self {
        Self {
            ends: SumTree::new(ordinal),
            ordinal,
            left: u32::MAX,
        }
    }

    /// The chunk that holds the next sequence, and how many it has left.
    fn next(&self) -> Option<(u64, u32)> {
        let left = self.left.min(self.ends.get(self.ordinal));
        if left > 0 {
            return Some((self.ordinal, left));
        }
        let before = self.ends.sum_before(self.ordinal.saturating_add(1));
        (before < self.ends.total()).then(|| {
            let (ordinal, _) = self.ends.find(before);
            (ordinal, self.ends.get(ordinal))
        })
    }
}

impl Selection for Fifo {
    fn chunk_changed(&mut self, chunk: &Span, ends: u32) {
        super::set_ends(&mut self.ends, chunk, ends);
    }

    fn forget_before(&mut self, ordinal: u64, _step: u64) {
        self.ends.forget_before(ordinal);
    }

    fn can_draw(&self) -> bool {
        self.next().is_some()
    }

    fn draw(&mut self, _rng: &mut ChaCha8Rng) -> Option<Pick> {
        let (ordinal, left) = self.next()?;
        self.ordinal = ordinal;
        self.left = left - 1;
        Some(Pick {
            target: Target::Chunk {
                ordinal,
                back: left,
            },
            probability: 1.0,
        })
    }
}
