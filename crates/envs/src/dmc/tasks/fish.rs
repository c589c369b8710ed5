//! A fish that swims upright, or to a target.

use super::{Made, Task, difference, joints, norm};
use crate::dmc::ControlError;
use crate::dmc::physics::{Joint, Physics};
use crate::dmc::random::RandomState;
use crate::dmc::rewards::{DEFAULT, near};

/// Joints that are drawn, in this order.
const JOINTS: [&str; 7] = [
    "tail1",
    "tail_twist",
    "tail2",
    "finright_roll",
    "finright_pitch",
    "finleft_roll",
    "finleft_pitch",
];

struct Fish {
    root: Joint,
    joints: [Joint; JOINTS.len()],
    torso: usize,
    mouth: usize,
    target: usize,
    swims: bool,
}

pub(super) fn upright(physics: &Physics) -> Made {
    new(physics, false)
}

pub(super) fn swim(physics: &Physics) -> Made {
    new(physics, true)
}

fn new(physics: &Physics, swims: bool) -> Made {
    let root = physics.joint("root")?;
    let mut joints = [root; JOINTS.len()];
    for (joint, name) in joints.iter_mut().zip(JOINTS) {
        *joint = physics.joint(name)?;
    }
    Ok(Box::new(Fish {
        root,
        joints,
        torso: physics.body("torso")?,
        mouth: physics.geom("mouth")?,
        target: physics.geom("target")?,
        swims,
    }))
}

impl Task for Fish {
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        let orientation = [(); 4].map(|()| random.randn());
        let qpos = physics.data_mut().qpos_mut();
        joints::set_orientation(&mut qpos[self.root.qpos + 3..][..4], orientation);
        for joint in self.joints {
            qpos[joint.qpos] = random.uniform(-0.2, 0.2);
        }
        let mut edit = physics.edit();
        if self.swims {
            let ranges = [(-0.4, 0.4), (-0.4, 0.4), (0.1, 0.3)];
            *edit.geom_pos(self.target) = ranges.map(|(low, high)| random.uniform(low, high));
        } else {
            edit.geom_rgba(self.target)[3] = 0.0;
        }
        Ok(())
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let upright = physics.upright(self.torso);
        if !self.swims {
            return near(upright, 1.0..=1.0, 1.0, DEFAULT);
        }
        let place = |geom: usize| physics.data().geom_xpos()[geom];
        let radius = |geom: usize| physics.model().geom_size()[geom][0];
        let distance = norm(&difference(place(self.mouth), place(self.target)));
        let radii = radius(self.mouth) + radius(self.target);
        let arrived = near(distance, 0.0..=radii, 2.0 * radii, DEFAULT);
        (7.0 * arrived + 0.5 * (upright + 1.0)) / 8.0
    }
}
