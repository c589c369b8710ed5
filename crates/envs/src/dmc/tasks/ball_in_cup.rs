//! A planar cup that catches the ball on its string.

use super::{Made, Task, joints};
use crate::dmc::ControlError;
use crate::dmc::physics::{Joint, Physics};
use crate::dmc::random::RandomState;

struct BallInCup {
    ball: usize,
    ball_geom: usize,
    ball_x: Joint,
    ball_z: Joint,
    /// The inside of the cup, a box.
    target: usize,
}

pub(super) fn catch(physics: &Physics) -> Made {
    Ok(Box::new(BallInCup {
        ball: physics.body("ball")?,
        ball_geom: physics.geom("ball")?,
        ball_x: physics.joint("ball_x")?,
        ball_z: physics.joint("ball_z")?,
        target: physics.site("target")?,
    }))
}

impl Task for BallInCup {
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        joints::without_contact(physics, |physics| {
            let qpos = physics.data_mut().qpos_mut();
            qpos[self.ball_x.qpos] = random.uniform(-0.2, 0.2);
            qpos[self.ball_z.qpos] = random.uniform(0.2, 0.5);
        })
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let ball = physics.data().xpos()[self.ball];
        let target = physics.data().site_xpos()[self.target];
        let ball_radius = physics.model().geom_size()[self.ball_geom][0];
        let half_size = physics.model().site_size()[self.target];
        let caught = [0, 2]
            .into_iter()
            .all(|axis| (target[axis] - ball[axis]).abs() < half_size[axis] - ball_radius);
        f64::from(u8::from(caught))
    }
}
