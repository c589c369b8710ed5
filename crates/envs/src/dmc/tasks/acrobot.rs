//! Two links with a motor at the elbow only, to be swung up and balanced.

use std::f64::consts::PI;

use super::{Made, Task, difference, norm};
use crate::dmc::ControlError;
use crate::dmc::physics::{Joint, Physics};
use crate::dmc::random::RandomState;
use crate::dmc::rewards::{DEFAULT, near, within};

struct Acrobot {
    shoulder: Joint,
    elbow: Joint,
    tip: usize,
    target: usize,
    sparse: bool,
}

pub(super) fn swingup(physics: &Physics) -> Made {
    new(physics, false)
}

pub(super) fn swingup_sparse(physics: &Physics) -> Made {
    new(physics, true)
}

fn new(physics: &Physics, sparse: bool) -> Made {
    Ok(Box::new(Acrobot {
        shoulder: physics.joint("shoulder")?,
        elbow: physics.joint("elbow")?,
        tip: physics.site("tip")?,
        target: physics.site("target")?,
        sparse,
    }))
}

impl Task for Acrobot {
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        for joint in [self.shoulder, self.elbow] {
            physics.data_mut().qpos_mut()[joint.qpos] = random.uniform(-PI, PI);
        }
        Ok(())
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let place = |site: usize| physics.data().site_xpos()[site];
        let distance = norm(&difference(place(self.tip), place(self.target)));
        let there = 0.0..=physics.model().site_size()[self.target][0];
        if self.sparse {
            within(distance, there)
        } else {
            near(distance, there, 1.0, DEFAULT)
        }
    }
}
