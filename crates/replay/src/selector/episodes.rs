//! Uniform over episodes that hold a sequence, unfinished ones included, then uniform over the episode's start
//! steps: the paper's way. An episode that damage split counts once per part. Its last step lies in one of its sequences
//! alone, others in as many as a sequence has steps: some draws may therefore be given to last sequences.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::run_set::RunSet;
use super::{Pick, Selection, Target};

/// `P(i) = ((1 - e) / sequences of its episode + (e where it is the last of them)) / episodes`, `e` being the share of
/// draws that take a last one.
#[derive(Debug)]
pub(super) struct Episodes {
    runs: RunSet,
    ends: f64,
}

impl Episodes {
    pub(super) fn new(ends: f64) -> Self {
        Self {
            runs: RunSet::new(),
            ends,
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
        let last = starts - 1;
        let start = if self.ends > 0.0 && rng.random_bool(self.ends) {
            last
        } else {
            rng.random_range(0..starts)
        };
        let extra = if start == last { self.ends } else { 0.0 };
        Some(Pick {
            target: Target::Run { run, start },
            probability: ((1.0 - self.ends) / f64::from(starts) + extra) / self.runs.runs() as f64,
        })
    }
}
