//! The sky, which does not change while the observer does not turn.

use super::scene::Assets;
use super::vec3::Vec3;
use super::view::{Lens, View};

/// The sky of every pixel.
#[derive(Debug, Default)]
pub(crate) struct Sky {
    /// `[height, width]`
    pub(crate) pixels: Vec<[f32; 3]>,
    /// What it was computed for.
    seen: Option<([Vec3; 3], Lens)>,
}

impl Sky {
    /// Makes it that of this observer.
    pub(crate) fn look(&mut self, assets: &Assets, view: &View, lens: &Lens) {
        let axes = [view.forward, view.right, view.up];
        if self
            .seen
            .as_ref()
            .is_some_and(|(a, b)| *a == axes && b == lens)
        {
            return;
        }
        self.pixels.clear();
        let [right, up] = [view.right * lens.pitch[0], view.up * lens.pitch[1]];
        for &y in &lens.middle_rows {
            for &x in &lens.middle_columns {
                let at = view.ray(x, y);
                self.pixels.push(match &assets.sky {
                    Some(sky) => {
                        let [at, right, down] = [at, at + right, at - up].map(to_cube);
                        sky.sample(at, right, down)
                    }
                    None => [0.0; 3],
                });
            }
        }
        self.seen = Some((axes, lens.clone()));
    }
}

/// The world's z is the cube's y.
fn to_cube(direction: Vec3) -> Vec3 {
    Vec3::new(direction.x, direction.z, -direction.y)
}
