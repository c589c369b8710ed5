//! Curved geoms as MuJoCo draws them: with flat facets, lit at their corners.
//!
//! The outline is that of the true form. But a pixel at the outline is lit where the facet's plane meets the ray
//! through the pixel's middle, outside of the facet, which makes outlines darker or brighter than the form is.

use std::sync::LazyLock;

use super::corners::{Blend, CornerLight, Lighting};
use super::maths::{angle, floor};
use super::scene::Shape;
use super::vec3::Vec3;

/// Facets around the axis: the models' `numslices`.
const SLICES: usize = 28;
/// Rows of facets between the equator and a pole: a half of the models' `numstacks`.
const ROWS: usize = 8;
/// Rows of facets along a cylinder: the models' `numstacks`.
const SIDE_ROWS: usize = 16;

/// Corners of the side of a cylinder.
const SIDE: usize = (SIDE_ROWS + 1) * SLICES;
/// Corners of a half ball.
const DOME: usize = (ROWS + 1) * SLICES;
/// Corners of the side and two half balls, as many as a form may have.
pub(crate) const CORNERS: usize = SIDE + 2 * DOME;

/// Part of a form, by the index of its first corner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Part {
    Side = 0,
    Upper = SIDE as isize,
    Lower = (SIDE + DOME) as isize,
}

/// Cosines and sines.
struct Angles {
    /// Of the slices, around the axis.
    slices: [[f32; 2]; SLICES],
    /// Of the rows of a half ball, from the equator to the pole.
    rows: [[f32; 2]; ROWS + 1],
}

static ANGLES: LazyLock<Angles> = LazyLock::new(|| {
    let direction = |whole: f64, index: usize, count: usize| {
        let angle = whole * index as f64 / count as f64;
        [angle.cos() as f32, angle.sin() as f32]
    };
    Angles {
        slices: std::array::from_fn(|k| direction(std::f64::consts::TAU, k, SLICES)),
        rows: std::array::from_fn(|k| direction(std::f64::consts::FRAC_PI_2, k, ROWS)),
    }
});

/// A flat triangle of a curved form.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Facet {
    form: Form,
    corners: [usize; 3],
}

/// A ball, squeezed, whose halves are `gap` away from the middle, or the side of a cylinder alone.
#[derive(Debug, Clone, Copy)]
struct Form {
    radii: Vec3,
    gap: f32,
}

impl Facet {
    /// The facet at a point of the surface; nothing where the form is flat.
    pub(crate) fn at(shape: &Shape, point: Vec3) -> Option<Self> {
        let (radii, gap) = match *shape {
            Shape::Sphere { radius } => (Vec3::new(radius, radius, radius), 0.0),
            Shape::Ellipsoid { radii } => (radii, 0.0),
            Shape::Capsule {
                radius,
                half_length,
            } => (Vec3::new(radius, radius, radius), half_length),
            Shape::Cylinder {
                radius,
                half_length,
            } if shape.normal(point).z == 0.0 => (Vec3::new(radius, radius, radius), half_length),
            _ => return None,
        };
        let (x, y) = (point.x / radii.x, point.y / radii.y);
        let (slice, across) = split(angle(y, x) / std::f32::consts::TAU, SLICES);
        let slice = slice % SLICES;
        let next = (slice + 1) % SLICES;
        let above = point.z.abs() - gap;
        let (part, row, along) = if gap > 0.0 && above <= 0.0 {
            let (row, along) = split(0.5 * (point.z / gap + 1.0), SIDE_ROWS);
            (Part::Side, row, along)
        } else {
            let height = angle(above / radii.z, (x * x + y * y).sqrt());
            let (row, along) = split(height / std::f32::consts::FRAC_PI_2, ROWS);
            let lower = point.z < 0.0;
            (if lower { Part::Lower } else { Part::Upper }, row, along)
        };
        let first = part as usize;
        let corner = |row: usize, slice: usize| first + row * SLICES + slice;
        let [a, b] = [corner(row, slice), corner(row, next)];
        let [c, d] = [corner(row + 1, next), corner(row + 1, slice)];
        let corners = if part != Part::Side && row + 1 == ROWS {
            // A quad that ends in the pole is one triangle.
            [a, b, d]
        } else if part == Part::Lower {
            // The diagonal goes the other way.
            if across <= along {
                [a, c, d]
            } else {
                [a, b, c]
            }
        } else if across + along <= 1.0 {
            [a, b, d]
        } else {
            [b, c, d]
        };
        Some(Self {
            form: Form { radii, gap },
            corners,
        })
    }

    /// Where the ray meets the facet's plane, as shares of its corners, and how far away; nothing if it does not
    /// come from the front.
    pub(crate) fn meet(&self, origin: Vec3, ray: Vec3) -> Option<([(usize, f32); 3], f32)> {
        let [a, b, c] = self.corners.map(|corner| self.form.corner(corner).0);
        let normal = (b - a).cross(c - a);
        // Corners are in no fixed order; the forms are around their middle.
        let outwards = if a.dot(normal) < 0.0 { -normal } else { normal };
        if ray.dot(outwards) >= 0.0 {
            return None;
        }
        let distance = (a - origin).dot(normal) / ray.dot(normal);
        let place = origin + ray * distance - a;
        let scale = 1.0 / normal.dot(normal);
        let second = place.cross(c - a).dot(normal) * scale;
        let third = (b - a).cross(place).dot(normal) * scale;
        let shares = [1.0 - second - third, second, third];
        let corners = std::array::from_fn(|k| (self.corners[k], shares[k]));
        Some((corners, distance))
    }

    /// The light at such shares, which is in `light` then.
    pub(crate) fn blend(
        &self,
        shares: [(usize, f32); 3],
        lighting: &Lighting<'_>,
        light: &mut CornerLight,
    ) -> Blend {
        for (corner, _) in shares {
            light.light(corner, lighting, || self.form.corner(corner));
        }
        Blend(shares)
    }
}

impl Form {
    /// Position and normal of a corner.
    fn corner(&self, corner: usize) -> (Vec3, Vec3) {
        let Angles { slices, rows } = &*ANGLES;
        let [x, y] = slices[corner % SLICES];
        if corner < SIDE {
            let share = (corner / SLICES) as f32 * (2.0 / SIDE_ROWS as f32) - 1.0;
            let position = Vec3::new(x * self.radii.x, y * self.radii.y, share * self.gap);
            return (position, Vec3::new(x, y, 0.0));
        }
        let sign = if corner < SIDE + DOME { 1.0 } else { -1.0 };
        let [cosine, sine] = rows[(corner - SIDE) % DOME / SLICES];
        let unit = Vec3::new(x * cosine, y * cosine, sign * sine);
        let position = unit.scale(self.radii) + Vec3::new(0.0, 0.0, sign * self.gap);
        let Vec3 { x, y, z } = self.radii;
        let normal = unit.scale(Vec3::new(1.0 / x, 1.0 / y, 1.0 / z)).unit();
        (position, normal)
    }
}

/// The part out of `parts` equal ones in which `share` of the whole is, and where in it.
fn split(share: f32, parts: usize) -> (usize, f32) {
    let at = share * parts as f32;
    let part = floor(at).clamp(0.0, (parts - 1) as f32);
    (part as usize, at - part)
}
