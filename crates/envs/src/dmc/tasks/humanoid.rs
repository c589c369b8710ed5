//! A humanoid that stands, walks or runs.

use super::{Made, Task, joints, norm};
use crate::dmc::ControlError;
use crate::dmc::physics::Physics;
use crate::dmc::random::RandomState;
use crate::dmc::rewards::{DEFAULT, Falloff, at_least, near, small_control};

/// Height of the head of a humanoid that stands.
const STAND_M: f64 = 1.4;

struct Humanoid {
    torso: usize,
    head: usize,
    velocity: usize,
    speed_m_s: Option<f64>,
}

/// At `speed_m_s`, or standing without one.
pub(super) fn new(physics: &Physics, speed_m_s: Option<f64>) -> Made {
    Ok(Box::new(Humanoid {
        torso: physics.body("torso")?,
        head: physics.body("head")?,
        velocity: physics.sensor("torso_subtreelinvel")?,
        speed_m_s,
    }))
}

impl Task for Humanoid {
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        joints::without_contact(physics, |physics| joints::randomize(physics, random))
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let data = physics.data();
        let height = data.xpos()[self.head][2];
        let standing = at_least(height, STAND_M, STAND_M / 4.0, DEFAULT);
        let upright = at_least(physics.upright(self.torso), 0.9, 1.9, Falloff::Linear(0.0));
        let gentle = (4.0 + small_control(data.ctrl())) / 5.0;
        let velocity = &data.sensordata()[self.velocity..][..2];
        let moving = match self.speed_m_s {
            None => {
                let still = velocity.iter().map(|&v| near(v, 0.0..=0.0, 2.0, DEFAULT));
                still.sum::<f64>() / 2.0
            }
            Some(target) => {
                let fast = at_least(norm(velocity), target, target, Falloff::Linear(0.0));
                (5.0 * fast + 1.0) / 6.0
            }
        };
        gentle * (standing * upright) * moving
    }
}
