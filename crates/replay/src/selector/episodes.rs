//! Uniform over episodes that hold a sequence, unfinished ones included, then uniform over the episode's start
//! steps: the paper's way. An episode that damage split counts once per part.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::run_set::RunSet;
use super::{Pick, Selection, Target};

/// `P(i) = 1 / (episodes * sequences of its episode)`.
#[derive(Debug)]
pub(super) struct Episodes {
    runs: RunSet,
}

impl Episodes {
    pub(super) fn new() -> Self {
        Self {
            runs: RunSet::new(),
        }
    }
}

impl Selection for Episodes {
    fn run_changed(&mut self, run: u32, starts: u32) {
        self.runs.set(run, starts);
    }

    fn can_draw(&self) -> bool {
        self.runs.runs() > 0
    }

    fn draw(&mut self, rng: &mut ChaCha8Rng) -> Option<Pick> {
        let (run, starts) = self.runs.draw_run(rng)?;
        let start = rng.random_range(0..starts);
        Some(Pick {
            target: Target::Run { run, start },
            probability: 1.0 / (self.runs.runs() as f64 * f64::from(starts)),
        })
    }
}
