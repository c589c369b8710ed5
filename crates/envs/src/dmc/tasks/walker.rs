//! A planar walker that stands, walks or runs.

use super::{Made, Task};
use crate::dmc::physics::Physics;
use crate::dmc::rewards::{DEFAULT, Falloff, at_least};

/// Height of a torso that stands.
const STAND_M: f64 = 1.2;

struct Walker {
    torso: usize,
    velocity: usize,
    speed_m_s: Option<f64>,
}

/// At `speed_m_s`, or standing without one.
pub(super) fn new(physics: &Physics, speed_m_s: Option<f64>) -> Made {
    Ok(Box::new(Walker {
        torso: physics.body("torso")?,
        velocity: physics.sensor("torso_subtreelinvel")?,
        speed_m_s,
    }))
}

impl Task for Walker {
    fn reward(&self, physics: &Physics) -> f64 {
        let height = physics.data().xpos()[self.torso][2];
        let standing = at_least(height, STAND_M, STAND_M / 2.0, DEFAULT);
        let upright = (1.0 + physics.upright(self.torso)) / 2.0;
        let stand = (3.0 * standing + upright) / 4.0;
        let Some(target) = self.speed_m_s else {
            return stand;
        };
        let speed = physics.data().sensordata()[self.velocity];
        let moving = at_least(speed, target, target / 2.0, Falloff::Linear(0.5));
        stand * (5.0 * moving + 1.0) / 6.0
    }
}
