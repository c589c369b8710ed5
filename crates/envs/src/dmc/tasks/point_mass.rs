//! A mass on a plane that is moved to the middle.

use super::{Made, Task, difference, norm};
use crate::dmc::physics::Physics;
use crate::dmc::rewards::{DEFAULT, near, small_control};

struct PointMass {
    mass: usize,
    target: usize,
}

pub(super) fn easy(physics: &Physics) -> Made {
    Ok(Box::new(PointMass {
        mass: physics.geom("pointmass")?,
        target: physics.geom("target")?,
    }))
}

impl Task for PointMass {
    fn reward(&self, physics: &Physics) -> f64 {
        let place = |geom: usize| physics.data().geom_xpos()[geom];
        let distance = norm(&difference(place(self.mass), place(self.target)));
        let radius = physics.model().geom_size()[self.target][0];
        let gentle = (small_control(physics.data().ctrl()) + 4.0) / 5.0;
        near(distance, 0.0..=radius, radius, DEFAULT) * gentle
    }
}
