//! Uniform over start steps: every sequence has the same probability, so that long episodes are drawn more.

use rand_chacha::ChaCha8Rng;

use super::run_set::RunSet;
use super::{Pick, Selection, Target};

/// `P(i) = 1 / n` over the `n` sequences held.
#[derive(Debug)]
pub(super) struct Steps {
    runs: RunSet,
}

impl Steps {
    pub(super) fn new() -> Self {
        Self {
            runs: RunSet::new(),
        }
    }
}

impl Selection for Steps {
    fn run_changed(&mut self, run: u32, starts: u32) {
        self.runs.set(run, starts);
    }

    fn can_draw(&self) -> bool {
        self.runs.starts() > 0
    }

    fn draw(&mut self, rng: &mut ChaCha8Rng) -> Option<Pick> {
        let (run, start) = self.runs.draw_start(rng)?;
        Some(Pick {
            target: Target::Run { run, start },
            probability: 1.0 / self.runs.starts() as f64,
        })
    }
}
