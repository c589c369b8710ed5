//! A cart that balances a pole, or swings it up first.

use std::f64::consts::PI;

use super::{Made, Task};
use crate::dmc::ControlError;
use crate::dmc::physics::{Joint, Physics};
use crate::dmc::random::RandomState;
use crate::dmc::rewards::{DEFAULT, near, small_control, within};

struct Cartpole {
    slider: Joint,
    hinge: Joint,
    pole: usize,
    swings_up: bool,
    sparse: bool,
}

pub(super) fn balance(physics: &Physics) -> Made {
    new(physics, false, false)
}

pub(super) fn balance_sparse(physics: &Physics) -> Made {
    new(physics, false, true)
}

pub(super) fn swingup(physics: &Physics) -> Made {
    new(physics, true, false)
}

pub(super) fn swingup_sparse(physics: &Physics) -> Made {
    new(physics, true, true)
}

fn new(physics: &Physics, swings_up: bool, sparse: bool) -> Made {
    Ok(Box::new(Cartpole {
        slider: physics.joint("slider")?,
        hinge: physics.joint("hinge_1")?,
        pole: physics.body("pole_1")?,
        swings_up,
        sparse,
    }))
}

impl Task for Cartpole {
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        let (slider, hinge) = if self.swings_up {
            (0.01 * random.randn(), PI + 0.01 * random.randn())
        } else {
            (random.uniform(-0.1, 0.1), random.uniform(-0.034, 0.034))
        };
        let qpos = physics.data_mut().qpos_mut();
        qpos[self.slider.qpos] = slider;
        qpos[self.hinge.qpos] = hinge;
        for velocity in physics.data_mut().qvel_mut() {
            *velocity = 0.01 * random.randn();
        }
        Ok(())
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let data = physics.data();
        let position = data.qpos()[self.slider.qpos];
        let cosine = physics.upright(self.pole);
        if self.sparse {
            return within(position, -0.25..=0.25) * within(cosine, 0.995..=1.0);
        }
        let upright = (cosine + 1.0) / 2.0;
        let centred = (1.0 + near(position, 0.0..=0.0, 2.0, DEFAULT)) / 2.0;
        let gentle = (4.0 + small_control(data.ctrl())) / 5.0;
        let velocity = data.qvel()[self.hinge.dof];
        let slow = (1.0 + near(velocity, 0.0..=0.0, 5.0, DEFAULT)) / 2.0;
        upright * gentle * slow * centred
    }
}
