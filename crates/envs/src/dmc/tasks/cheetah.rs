//! A planar cheetah that runs.

use super::{Made, Task, joints};
use crate::dmc::ControlError;
use crate::dmc::physics::Physics;
use crate::dmc::random::RandomState;
use crate::dmc::rewards::{Falloff, at_least};

const RUN_M_S: f64 = 10.0;
/// Time steps in which the cheetah falls on its feet before the episode begins.
const SETTLING_STEPS: usize = 200;

struct Cheetah {
    velocity: usize,
}

pub(super) fn run(physics: &Physics) -> Made {
    Ok(Box::new(Cheetah {
        velocity: physics.sensor("torso_subtreelinvel")?,
    }))
}

impl Task for Cheetah {
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        joints::randomize_limited(physics, random);
        physics.step(SETTLING_STEPS);
        physics.data_mut().set_time(0.0);
        Ok(())
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let speed = physics.data().sensordata()[self.velocity];
        at_least(speed, RUN_M_S, RUN_M_S, Falloff::Linear(0.0))
    }
}
