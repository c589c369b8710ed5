//! A mixture that favours the newest: with `probability` uniform over the `newest` sequences whose last step
//! arrived last (all, where fewer are held), else uniform over all.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::sum_tree::SumTree;
use super::{Pick, Selection, Span, Target};

/// `P(i) = (1 - probability) / n`, and `probability / newest` more for the newest ones.
#[derive(Debug)]
pub(super) struct Recent {
    newest: u64,
    probability: f64,
    /// Sequences that end in each chunk.
    ends: SumTree,
}

impl Recent {
    pub(super) fn new(newest: u64, probability: f64, ordinal: u64) -> Self {
        Self {
            newest,
            probability,
            ends: SumTree::new(ordinal),
        }
    }
}

impl Selection for Recent {
    fn chunk_changed(&mut self, chunk: &Span, ends: u32) {
        super::set_ends(&mut self.ends, chunk, ends);
    }

    fn forget_before(&mut self, ordinal: u64, _step: u64) {
        self.ends.forget_before(ordinal);
    }

    fn can_draw(&self) -> bool {
        self.ends.total() > 0
    }

    fn draw(&mut self, rng: &mut ChaCha8Rng) -> Option<Pick> {
        let total = self.ends.total();
        if total == 0 {
            return None;
        }
        let newest = self.newest.min(total);
        let first = if rng.random_bool(self.probability) {
            total - newest
        } else {
            0
        };
        let rank = rng.random_range(first..total);
        let (ordinal, inside) = self.ends.find(rank);
        let mut probability = (1.0 - self.probability) / total as f64;
        if rank >= total - newest {
            probability += self.probability / newest as f64;
        }
        Some(Pick {
            target: Target::Chunk {
                ordinal,
                back: self.ends.get(ordinal) - inside,
            },
            probability,
        })
    }
}
