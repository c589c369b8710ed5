//! What lies between a light and a point.

use super::mesh::Mesh;
use super::scene::{Geom, Light, LightKind};
use super::shape::Rays;
use super::vec3::{Frame, Vec3};
use super::view::{Lens, Rect, View};

/// A light that throws shadows, prepared for one scene.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Caster {
    position: Vec3,
    directional: bool,
    /// To the side, upwards and along the light.
    axes: [Vec3; 3],
    /// How far from its axis it throws shadows, in metres or as a tangent.
    reach: f32,
}

/// The way of light to a point: from `start` along `direction`, which ends at the point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Path {
    start: Vec3,
    direction: Vec3,
}

/// Nearer to the end of its way than this share, a body does not shade: it is the lit one.
const END: f32 = 1.0 - 1e-4;

impl Caster {
    pub(crate) fn new(light: &Light, reach: f32) -> Self {
        let forward = light.direction.unit();
        // MuJoCo's choice, which turns the edge of the region with shadows.
        let across = forward.cross(Vec3::new(-1.0, 0.0, 0.0));
        let up = if across.dot(across) > 0.01 {
            across.unit()
        } else {
            forward.cross(Vec3::new(0.0, 1.0, 0.0)).unit()
        };
        Self {
            position: light.position,
            directional: light.kind == LightKind::Directional,
            axes: [forward.cross(up).unit(), up, forward],
            reach,
        }
    }

    /// The way to `point`, if it is where the light throws shadows.
    pub(crate) fn path(&self, point: Vec3) -> Option<Path> {
        let offset = point - self.position;
        let [x, y, depth] = self.axes.map(|axis| offset.dot(axis));
        let reach = if self.directional {
            self.reach
        } else {
            self.reach * depth
        };
        if depth <= 0.0 || x.abs() > reach || y.abs() > reach {
            return None;
        }
        let direction = if self.directional {
            self.axes[2] * depth
        } else {
            offset
        };
        Some(Path {
            start: point - direction,
            direction,
        })
    }

    /// Pixels of a plane that the shadow of a body with these corners may reach.
    pub(crate) fn rect(&self, lens: &Lens, view: &View, plane: &Frame, corners: &[Vec3]) -> Rect {
        let mut shadow = [Vec3::default(); 8];
        for (shadow, &corner) in shadow.iter_mut().zip(corners) {
            let ray = if self.directional {
                self.axes[2]
            } else {
                corner - self.position
            };
            let normal = plane.axes[2];
            let distance = (plane.position - corner).dot(normal) / ray.dot(normal);
            *shadow = corner + ray * distance;
            if ray.dot(normal) >= 0.0 {
                // The light does not come down on the plane there: look everywhere.
                return view.rect(lens, &[view.origin]);
            }
        }
        view.rect(lens, &shadow[..corners.len()])
    }
}

impl Path {
    /// Whether the geom is in the way.
    pub(crate) fn meets(&self, geom: &Geom, meshes: &[Mesh]) -> bool {
        let start = geom.frame.to_local(self.start - geom.frame.position);
        let direction = geom.frame.to_local(self.direction);
        let [enter] = geom.shape.enter(meshes, start, &Rays::one(direction));
        enter > 0.0 && enter < END
    }

    /// Whether it comes nearer than `radius` to `centre`.
    pub(crate) fn passes(&self, centre: Vec3, radius: f32) -> bool {
        let offset = (centre - self.start).cross(self.direction);
        offset.dot(offset) <= radius * radius * self.direction.dot(self.direction)
    }
}
