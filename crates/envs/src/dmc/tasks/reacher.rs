//! A planar arm that reaches for a target.

use std::f64::consts::TAU;

use super::{Made, Task, joints, norm};
use crate::dmc::ControlError;
use crate::dmc::physics::Physics;
use crate::dmc::random::RandomState;
use crate::dmc::rewards::within;

struct Reacher {
    finger: usize,
    target: usize,
    target_radius_m: f64,
}

pub(super) fn new(physics: &Physics, target_radius_m: f64) -> Made {
    Ok(Box::new(Reacher {
        finger: physics.geom("finger")?,
        target: physics.geom("target")?,
        target_radius_m,
    }))
}

impl Task for Reacher {
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        physics.edit().geom_size(self.target)[0] = self.target_radius_m;
        joints::randomize(physics, random);
        let angle = random.uniform(0.0, TAU);
        let radius = random.uniform(0.05, 0.20);
        let mut edit = physics.edit();
        let target = edit.geom_pos(self.target);
        target[0] = radius * angle.sin();
        target[1] = radius * angle.cos();
        Ok(())
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let place = |geom: usize| physics.data().geom_xpos()[geom];
        let radius = |geom: usize| physics.model().geom_size()[geom][0];
        let off = [0, 1].map(|axis| place(self.target)[axis] - place(self.finger)[axis]);
        within(norm(&off), 0.0..=radius(self.target) + radius(self.finger))
    }
}
