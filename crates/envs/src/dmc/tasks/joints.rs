//! Random poses.

use std::f64::consts::PI;

use mujoco_rs::prelude::MjtJoint;

use super::norm;
use crate::dmc::ControlError;
use crate::dmc::physics::Physics;
use crate::dmc::random::RandomState;

/// Poses that are drawn before giving up.
const ATTEMPTS: usize = 1000;

/// Draws joints in their order: hinges and slides with limits between these, other hinges anywhere, the orientation
/// of a free joint. Slides without limits and the place of a free joint stay.
pub(super) fn randomize(physics: &mut Physics, random: &mut RandomState) {
    for joint in 0..physics.model().jnt_type().len() {
        randomize_joint(joint, physics, random);
    }
}

fn randomize_joint(joint: usize, physics: &mut Physics, random: &mut RandomState) {
    let model = physics.model();
    let [low, high] = model.jnt_range()[joint];
    let limited = model.jnt_limited()[joint];
    let kind = model.jnt_type()[joint];
    let address = model.jnt_qposadr()[joint] as usize;
    let qpos = physics.data_mut().qpos_mut();
    match kind {
        MjtJoint::mjJNT_HINGE | MjtJoint::mjJNT_SLIDE if limited => {
            qpos[address] = random.uniform(low, high);
        }
        MjtJoint::mjJNT_HINGE => qpos[address] = random.uniform(-PI, PI),
        MjtJoint::mjJNT_FREE => {
            // Not uniform over orientations: dm_control keeps that for the sake of published results.
            let drawn = [(); 4].map(|()| random.random_sample());
            set_orientation(&mut qpos[address + 3..][..4], drawn);
        }
        _ => {}
    }
}

/// Draws the joints that have limits, in their order.
pub(super) fn randomize_limited(physics: &mut Physics, random: &mut RandomState) {
    for joint in 0..physics.model().jnt_type().len() {
        if physics.model().jnt_limited()[joint] {
            randomize_joint(joint, physics, random);
        }
    }
}

/// Writes the unit quaternion in the direction of `quaternion`.
pub(super) fn set_orientation(qpos: &mut [f64], quaternion: [f64; 4]) {
    let length = norm(&quaternion);
    for (to, from) in qpos.iter_mut().zip(quaternion) {
        *to = from / length;
    }
}

/// Repeats `draw` until nothing touches anything.
pub(super) fn without_contact(
    physics: &mut Physics,
    mut draw: impl FnMut(&mut Physics),
) -> Result<(), ControlError> {
    for _ in 0..ATTEMPTS {
        draw(physics);
        physics.forward();
        if physics.contacts() == 0 {
            return Ok(());
        }
    }
    Err(ControlError::NoFreePose { attempts: ATTEMPTS })
}
