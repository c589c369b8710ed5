//! Varied experience: actions that are held for a while.

use std::ops::{Range, RangeInclusive};

use isodream_core::derive_seed;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::Driver;
use crate::{EnvError, Environment};

/// Agent steps for which a component is held.
const HELD_STEPS: RangeInclusive<u32> = 5..=15;
/// Range of the highway's pedal: more throttle than brake, or the ego stands most of the time.
const PEDAL: Range<f32> = -0.3..1.0;
/// Range of the highway's steer, its third power taken: mostly straight on.
const STEER: f32 = 0.25;

/// Draws each component of the action anew every 5 to 15 steps, and how much noise is added to it in each of them; the
/// sum is clamped to `[-1, 1]`. Components are uniform in `[-1, 1]`; on the highway, the pedal is uniform in
/// `[-0.3, 1]`, and steer is `0.25 u^3` with `u` uniform in `[-1, 1]`, a standard deviation of 0.09. The noise is uniform
/// within plus and minus `v^3` with `v` uniform in `[0, 1]`: mostly small, and at times as wide as the range, so that it
/// is seen what hard steering costs.
#[derive(Debug, Clone)]
pub struct WanderDriver {
    rng: ChaCha8Rng,
    held: Vec<Held>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Held {
    value: f32,
    noise: f32,
    steps: u32,
}

impl WanderDriver {
    /// A driver whose actions follow from `seed`.
    pub fn new(seed: u64) -> Self {
        Self {
            rng: ChaCha8Rng::seed_from_u64(derive_seed(seed, &["wander-driver"])),
            held: Vec::new(),
        }
    }

    fn draw(&mut self, on_highway: bool, index: usize) -> f32 {
        match (on_highway, index) {
            (true, 0) => STEER * self.rng.random_range(-1.0_f32..=1.0).powi(3),
            (true, _) => self.rng.random_range(PEDAL),
            (false, _) => self.rng.random_range(-1.0..=1.0),
        }
    }
}

impl Driver for WanderDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        let on_highway = env.spec().id.starts_with("highway/");
        self.held.resize(env.spec().action_dim, Held::default());
        let mut action = Vec::with_capacity(self.held.len());
        for index in 0..self.held.len() {
            if self.held[index].steps == 0 {
                self.held[index] = Held {
                    value: self.draw(on_highway, index),
                    noise: self.rng.random_range(0.0_f32..=1.0).powi(3),
                    steps: self.rng.random_range(HELD_STEPS),
                };
            }
            self.held[index].steps -= 1;
            let noise = self.held[index].noise * self.rng.random_range(-1.0_f32..=1.0);
            action.push((self.held[index].value + noise).clamp(-1.0, 1.0));
        }
        Ok(action)
    }
}
