//! A planar finger that spins a body, or turns it to a target.

use std::f64::consts::PI;

use super::{Made, Task, joints, norm};
use crate::dmc::ControlError;
use crate::dmc::physics::{Joint, Physics};
use crate::dmc::random::RandomState;

const SPIN_RAD_S: f64 = 15.0;
/// A free spinner, as the spin task has it.
const SPIN_DAMPING: f64 = 0.03;

struct Spin {
    hinge: Joint,
    velocity: usize,
    target: usize,
    tip: usize,
}

pub(super) fn spin(physics: &Physics) -> Made {
    Ok(Box::new(Spin {
        hinge: physics.joint("hinge")?,
        velocity: physics.sensor("hinge_velocity")?,
        target: physics.site("target")?,
        tip: physics.site("tip")?,
    }))
}

impl Task for Spin {
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        let mut edit = physics.edit();
        edit.site_rgba(self.target)[3] = 0.0;
        edit.site_rgba(self.tip)[3] = 0.0;
        *edit.dof_damping(self.hinge.dof) = SPIN_DAMPING;
        joints::without_contact(physics, |physics| joints::randomize(physics, random))
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let spins = physics.data().sensordata()[self.velocity] <= -SPIN_RAD_S;
        f64::from(u8::from(spins))
    }
}

struct Turn {
    hinge: Joint,
    /// A half of the spinner, whose size tells how far out the target is.
    cap: usize,
    target: usize,
    target_radius_m: f64,
    target_sensor: usize,
    tip_sensor: usize,
}

pub(super) fn turn(physics: &Physics, target_radius_m: f64) -> Made {
    Ok(Box::new(Turn {
        hinge: physics.joint("hinge")?,
        cap: physics.geom("cap1")?,
        target: physics.site("target")?,
        target_radius_m,
        target_sensor: physics.sensor("target")?,
        tip_sensor: physics.sensor("tip")?,
    }))
}

impl Task for Turn {
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        let angle = random.uniform(-PI, PI);
        let [x, _, z] = physics.data().xanchor()[self.hinge.id];
        let radius: f64 = physics.model().geom_size()[self.cap].iter().sum();
        let mut edit = physics.edit();
        let target = edit.site_pos(self.target);
        target[0] = x + radius * angle.sin();
        target[2] = z + radius * angle.cos();
        edit.site_size(self.target)[0] = self.target_radius_m;
        joints::without_contact(physics, |physics| joints::randomize(physics, random))
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let sensors = physics.data().sensordata();
        let off =
            [0, 2].map(|axis| sensors[self.target_sensor + axis] - sensors[self.tip_sensor + axis]);
        f64::from(u8::from(norm(&off) <= self.target_radius_m))
    }
}
