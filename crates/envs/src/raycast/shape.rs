//! Rays against the forms of geoms, several rays at once.

use super::mesh::Mesh;
use super::scene::Shape;
use super::vec3::Vec3;

/// No hit.
pub(crate) const MISS: f32 = f32::INFINITY;

/// Directions of `N` rays from one point, laid out so that the compiler computes them together.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rays<const N: usize> {
    pub(crate) x: [f32; N],
    pub(crate) y: [f32; N],
    pub(crate) z: [f32; N],
}

impl Rays<1> {
    pub(crate) fn one(direction: Vec3) -> Self {
        Self {
            x: [direction.x],
            y: [direction.y],
            z: [direction.z],
        }
    }
}

impl<const N: usize> Rays<N> {
    fn direction(&self, ray: usize) -> Vec3 {
        Vec3::new(self.x[ray], self.y[ray], self.z[ray])
    }
}

impl Shape {
    /// Where each ray from `origin` enters the form from outside, in multiples of its direction, or [`MISS`].
    /// Negative where it would have to go backwards.
    pub(crate) fn enter<const N: usize>(
        &self,
        meshes: &[Mesh],
        origin: Vec3,
        rays: &Rays<N>,
    ) -> [f32; N] {
        match *self {
            Self::Plane { half, .. } => std::array::from_fn(|k| {
                let distance = -origin.z / rays.z[k];
                let x = origin.x + distance * rays.x[k];
                let y = origin.y + distance * rays.y[k];
                let inside = |at: f32, half: f32| half <= 0.0 || at.abs() <= half;
                let hit = inside(x, half[0]) & inside(y, half[1]) & distance.is_finite();
                if hit { distance } else { MISS }
            }),
            Self::Sphere { radius } => {
                let origin = origin * (1.0 / radius);
                let scale = Vec3::new(1.0, 1.0, 1.0) * (1.0 / radius);
                std::array::from_fn(|k| unit_sphere(origin, rays.direction(k).scale(scale)))
            }
            Self::Ellipsoid { radii } => {
                let scale = Vec3::new(1.0 / radii.x, 1.0 / radii.y, 1.0 / radii.z);
                let origin = origin.scale(scale);
                std::array::from_fn(|k| unit_sphere(origin, rays.direction(k).scale(scale)))
            }
            Self::Capsule {
                radius,
                half_length,
            } => std::array::from_fn(|k| capsule(origin, rays.direction(k), radius, half_length)),
            Self::Cylinder {
                radius,
                half_length,
            } => std::array::from_fn(|k| {
                let direction = rays.direction(k);
                let side = tube(origin, direction, radius);
                let ends = slab(origin.z, direction.z, half_length);
                entry([side.0.max(ends.0), side.1.min(ends.1)])
            }),
            Self::Box { half } => std::array::from_fn(|k| {
                let direction = rays.direction(k);
                let x = slab(origin.x, direction.x, half.x);
                let y = slab(origin.y, direction.y, half.y);
                let z = slab(origin.z, direction.z, half.z);
                entry([x.0.max(y.0).max(z.0), x.1.min(y.1).min(z.1)])
            }),
            Self::Mesh { index } => std::array::from_fn(|k| {
                let hit = meshes[index].hit(origin, rays.direction(k), 0.0);
                hit.map_or(MISS, |hit| hit.distance)
            }),
        }
    }

    /// The direction outwards at a point of the surface, a unit vector. A mesh knows it only from the hit.
    pub(crate) fn normal(&self, at: Vec3) -> Vec3 {
        match *self {
            Self::Plane { .. } | Self::Mesh { .. } => Vec3::new(0.0, 0.0, 1.0),
            Self::Sphere { .. } => at.unit(),
            Self::Ellipsoid { radii } => Vec3::new(
                at.x / (radii.x * radii.x),
                at.y / (radii.y * radii.y),
                at.z / (radii.z * radii.z),
            )
            .unit(),
            Self::Capsule { half_length, .. } => {
                Vec3::new(at.x, at.y, at.z - at.z.clamp(-half_length, half_length)).unit()
            }
            Self::Cylinder {
                radius,
                half_length,
            } => {
                let distance = (at.x * at.x + at.y * at.y).sqrt();
                if half_length - at.z.abs() < radius - distance {
                    Vec3::new(0.0, 0.0, 1.0_f32.copysign(at.z))
                } else {
                    Vec3::new(at.x, at.y, 0.0).unit()
                }
            }
            Self::Box { half } => {
                let depth = half - at.abs();
                if depth.x <= depth.y && depth.x <= depth.z {
                    Vec3::new(1.0_f32.copysign(at.x), 0.0, 0.0)
                } else if depth.y <= depth.z {
                    Vec3::new(0.0, 1.0_f32.copysign(at.y), 0.0)
                } else {
                    Vec3::new(0.0, 0.0, 1.0_f32.copysign(at.z))
                }
            }
        }
    }

    /// Centre and half sizes of a box around it; nothing for an endless plane.
    pub(crate) fn bounds(&self, meshes: &[Mesh]) -> Option<(Vec3, Vec3)> {
        let half = match *self {
            Self::Plane { half: [x, y], .. } if x > 0.0 && y > 0.0 => Vec3::new(x, y, 0.0),
            Self::Plane { .. } => return None,
            Self::Sphere { radius } => Vec3::new(radius, radius, radius),
            Self::Capsule {
                radius,
                half_length,
            } => Vec3::new(radius, radius, half_length + radius),
            Self::Ellipsoid { radii } => radii,
            Self::Cylinder {
                radius,
                half_length,
            } => Vec3::new(radius, radius, half_length),
            Self::Box { half } => half,
            Self::Mesh { index } => return Some(meshes[index].bounds()),
        };
        Some((Vec3::default(), half))
    }

    /// Whether no straight line leaves it and enters it again.
    pub(crate) fn is_convex(&self) -> bool {
        !matches!(self, Self::Mesh { .. })
    }
}

#[inline(always)]
fn entry([enter, leave]: [f32; 2]) -> f32 {
    if enter <= leave { enter } else { MISS }
}

#[inline(always)]
fn unit_sphere(origin: Vec3, direction: Vec3) -> f32 {
    let square = direction.dot(direction);
    // The cross product keeps the digits which b^2 - 4ac loses for a small ball far away.
    let off = direction.cross(origin);
    let inside = square - off.dot(off);
    let distance = (-direction.dot(origin) - inside.max(0.0).sqrt()) / square;
    if inside >= 0.0 { distance } else { MISS }
}

/// Where a line enters and leaves the endless cylinder around z.
#[inline(always)]
fn tube(origin: Vec3, direction: Vec3, radius: f32) -> (f32, f32) {
    let square = direction.x * direction.x + direction.y * direction.y;
    let off = direction.x * origin.y - direction.y * origin.x;
    let inside = square * radius * radius - off * off;
    let middle = -(direction.x * origin.x + direction.y * origin.y) / square;
    let reach = inside.max(0.0).sqrt() / square;
    let within = origin.x * origin.x + origin.y * origin.y <= radius * radius;
    let parallel = square <= 1e-14 * direction.z * direction.z;
    let hit = if parallel { within } else { inside >= 0.0 };
    let enter = if parallel { -MISS } else { middle - reach };
    let leave = if parallel { MISS } else { middle + reach };
    (
        if hit { enter } else { MISS },
        if hit { leave } else { -MISS },
    )
}

/// Where a line enters and leaves the layer `|z| <= half`.
#[inline(always)]
fn slab(origin: f32, direction: f32, half: f32) -> (f32, f32) {
    let inverse = 1.0 / direction;
    let (first, second) = ((-half - origin) * inverse, (half - origin) * inverse);
    (first.min(second), first.max(second))
}

#[inline(always)]
fn capsule(origin: Vec3, direction: Vec3, radius: f32, half_length: f32) -> f32 {
    let (enter, leave) = tube(origin, direction, radius);
    let z = origin.z + enter * direction.z;
    let end = if enter == -MISS { -direction.z } else { z };
    let centre = half_length.copysign(end);
    let ball = Vec3::new(origin.x, origin.y, origin.z - centre);
    let scale = 1.0 / radius;
    let round = unit_sphere(ball * scale, direction * scale);
    let side = if z.abs() <= half_length { enter } else { round };
    if enter <= leave { side } else { MISS }
}
