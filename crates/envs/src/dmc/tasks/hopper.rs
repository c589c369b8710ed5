//! A planar one-legged hopper that stands or hops.

use super::{Made, Task};
use crate::dmc::physics::Physics;
use crate::dmc::rewards::{Falloff, at_least, small_control, within};

/// Height of the torso above the foot that counts as standing.
const STAND_M: f64 = 0.6;
/// What no standing hopper exceeds.
const HIGHEST_M: f64 = 2.0;
const HOP_M_S: f64 = 2.0;

struct Hopper {
    torso: usize,
    foot: usize,
    velocity: usize,
    hops: bool,
}

pub(super) fn stand(physics: &Physics) -> Made {
    new(physics, false)
}

pub(super) fn hop(physics: &Physics) -> Made {
    new(physics, true)
}

fn new(physics: &Physics, hops: bool) -> Made {
    Ok(Box::new(Hopper {
        torso: physics.body("torso")?,
        foot: physics.body("foot")?,
        velocity: physics.sensor("torso_subtreelinvel")?,
        hops,
    }))
}

impl Task for Hopper {
    fn reward(&self, physics: &Physics) -> f64 {
        let data = physics.data();
        let height = data.xipos()[self.torso][2] - data.xipos()[self.foot][2];
        let standing = within(height, STAND_M..=HIGHEST_M);
        if self.hops {
            let speed = data.sensordata()[self.velocity];
            standing * at_least(speed, HOP_M_S, HOP_M_S / 2.0, Falloff::Linear(0.5))
        } else {
            standing * ((small_control(data.ctrl()) + 4.0) / 5.0)
        }
    }
}
