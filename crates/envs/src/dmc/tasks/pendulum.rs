//! A pendulum that is too heavy for its motor, to be swung up and balanced.

use std::f64::consts::PI;

use super::{Made, Task};
use crate::dmc::ControlError;
use crate::dmc::physics::{Joint, Physics};
use crate::dmc::random::RandomState;
use crate::dmc::rewards::within;

/// How far from upright is still rewarded.
const TILT_DEG: f64 = 8.0;

struct Pendulum {
    hinge: Joint,
    pole: usize,
}

pub(super) fn swingup(physics: &Physics) -> Made {
    Ok(Box::new(Pendulum {
        hinge: physics.joint("hinge")?,
        pole: physics.body("pole")?,
    }))
}

impl Task for Pendulum {
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        physics.data_mut().qpos_mut()[self.hinge.qpos] = random.uniform(-PI, PI);
        Ok(())
    }

    fn reward(&self, physics: &Physics) -> f64 {
        within(
            physics.upright(self.pole),
            TILT_DEG.to_radians().cos()..=1.0,
        )
    }
}
