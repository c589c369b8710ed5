//! In proportion to priorities that the learner sets.
//!
//! `P(i) = p_i^exponent / sum_j p_j^exponent`. A new sequence takes the greatest priority ever set (1 before
//! the first), so that each is likely to be seen once. Priority 0 is never drawn. `p^exponent` is kept with 16
//! bits behind the binary point, between 1.5e-5 and 65,536: what lies outside is clamped.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::sum_tree::SumTree;
use super::{Pick, Selection, Span, Target};

const ONE: f64 = 65_536.0;

/// One weight for each step that is held; 0 for those that end no sequence.
#[derive(Debug)]
pub(super) struct Prioritized {
    exponent: f64,
    weights: SumTree,
    greatest: u32,
}

impl Prioritized {
    pub(super) fn new(exponent: f64, step: u64) -> Self {
        Self {
            exponent,
            weights: SumTree::new(step),
            greatest: ONE as u32,
        }
    }

    fn weight(&self, priority: f32) -> u32 {
        if priority == 0.0 {
            return 0;
        }
        let weight = f64::from(priority).powf(self.exponent) * ONE;
        weight.round().clamp(1.0, f64::from(u32::MAX)) as u32
    }
}

impl Selection for Prioritized {
    fn chunk_changed(&mut self, chunk: &Span, ends: u32) {
        let first_end = chunk.steps.end - u64::from(ends);
        if chunk.steps.start == self.weights.end() {
            for step in chunk.steps.clone() {
                let weight = if step < first_end { 0 } else { self.greatest };
                self.weights.push(weight);
            }
        } else {
            self.weights.clear(chunk.steps.start..first_end);
        }
    }

    fn forget_before(&mut self, _ordinal: u64, step: u64) {
        self.weights.forget_before(step);
    }

    fn can_draw(&self) -> bool {
        self.weights.total() > 0
    }

    fn draw(&mut self, rng: &mut ChaCha8Rng) -> Option<Pick> {
        let total = self.weights.total();
        if total == 0 {
            return None;
        }
        let (number, _) = self.weights.find(rng.random_range(0..total));
        Some(Pick {
            target: Target::Step { number },
            probability: f64::from(self.weights.get(number)) / total as f64,
        })
    }

    fn set_priority(&mut self, step: u64, priority: f32) -> bool {
        let weight = self.weight(priority);
        self.greatest = self.greatest.max(weight);
        self.weights.set(step, weight)
    }
}
