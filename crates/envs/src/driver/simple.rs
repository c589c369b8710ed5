//! Drivers that plan nothing.

use isodream_core::derive_seed;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::controls::{Following, drive, steer, view};
use super::{Driver, SHOULDER_D_M};
use crate::{EnvError, Environment};

/// Draws each component uniformly from `[-1, 1]`.
#[derive(Debug, Clone)]
pub struct RandomDriver {
    rng: ChaCha8Rng,
}

impl RandomDriver {
    /// A driver whose actions follow from `seed`.
    pub fn new(seed: u64) -> Self {
        Self {
            rng: ChaCha8Rng::seed_from_u64(derive_seed(seed, &["random-driver"])),
        }
    }
}

impl Driver for RandomDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        Ok((0..env.spec().action_dim)
            .map(|_| self.rng.random_range(-1.0..=1.0))
            .collect())
    }
}

/// Stays in the lane it starts in, behind whoever drives there.
#[derive(Debug, Clone, Default)]
pub struct KeepLaneDriver {
    lane: Option<usize>,
}

impl Driver for KeepLaneDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        let view = view(env)?;
        let lane = *self.lane.get_or_insert(view.lane);
        Ok(drive(&view, lane, Following::NORMAL))
    }
}

/// Holds a lateral position and the pedal, whoever is in the way.
#[derive(Debug, Clone)]
pub struct BlindDriver {
    pedal: f32,
    d_m: Option<f64>,
}

impl BlindDriver {
    /// Keeps the lane it starts in and holds `pedal`: 1 is full throttle, -1 the full brake.
    pub fn new(pedal: f32) -> Self {
        Self { pedal, d_m: None }
    }

    /// Goes to [`SHOULDER_D_M`] and holds `pedal`.
    pub fn on_the_shoulder(pedal: f32) -> Self {
        Self {
            pedal,
            d_m: Some(SHOULDER_D_M),
        }
    }
}

impl Driver for BlindDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        let view = view(env)?;
        let d_m = *(self.d_m).get_or_insert_with(|| view.lane_center_m(view.lane));
        Ok(vec![steer(&view, d_m) as f32, self.pedal])
    }
}

/// Brakes for ever: the worst that a driver without accidents can earn.
#[derive(Debug, Clone, Copy, Default)]
pub struct StandStillDriver;

impl Driver for StandStillDriver {
    fn act(&mut self, _env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        Ok(vec![0.0, -1.0])
    }
}
