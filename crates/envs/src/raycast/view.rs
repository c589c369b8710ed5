//! From pixels to rays and back.

use super::scene::Camera;
use super::shape::Rays;
use super::vec3::{Frame, Vec3};

/// Samples of every pixel.
pub(crate) const SAMPLES: usize = 4;

/// Where the samples are in a pixel, x to the right and y down: a square turned so that no two share a row or
/// column.
const PATTERN: [[f32; 2]; SAMPLES] = [
    [0.375, 0.875],
    [0.875, 0.625],
    [0.125, 0.375],
    [0.625, 0.125],
];

/// The directions of a picture's pixels, as tangents to the right of and above the axis.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Lens {
    /// Of the samples of each column.
    pub(crate) columns: Vec<[f32; SAMPLES]>,
    /// Of the samples of each row.
    pub(crate) rows: Vec<[f32; SAMPLES]>,
    /// Of the middles of columns.
    pub(crate) middle_columns: Vec<f32>,
    /// Of the middles of rows.
    pub(crate) middle_rows: Vec<f32>,
    /// From one column to the next, and from one row up to the one before.
    pub(crate) pitch: [f32; 2],
    /// Of the left and the upper edge.
    corner: [f32; 2],
}

impl Lens {
    pub(crate) fn new(camera: &Camera, width: usize, height: usize) -> Self {
        let [bottom, top] = camera.vertical;
        let across = (top - bottom) * width as f32 / height as f32;
        let left = camera.centre - 0.5 * across;
        let pitch = [across / width as f32, (top - bottom) / height as f32];
        let column = |x: f32| left + pitch[0] * x;
        let row = |y: f32| top - pitch[1] * y;
        let columns = (0..width).map(|i| PATTERN.map(|[x, _]| column(i as f32 + x)));
        let rows = (0..height).map(|j| PATTERN.map(|[_, y]| row(j as f32 + y)));
        Self {
            columns: columns.collect(),
            rows: rows.collect(),
            middle_columns: (0..width).map(|i| column(i as f32 + 0.5)).collect(),
            middle_rows: (0..height).map(|j| row(j as f32 + 0.5)).collect(),
            pitch,
            corner: [left, top],
        }
    }

    fn whole(&self) -> Rect {
        Rect {
            columns: [0, self.columns.len()],
            rows: [0, self.rows.len()],
        }
    }
}

/// An observer's place and axes, in the world or in the frame of a geom.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct View {
    pub(crate) origin: Vec3,
    pub(crate) forward: Vec3,
    pub(crate) right: Vec3,
    pub(crate) up: Vec3,
}

impl View {
    pub(crate) fn new(camera: &Camera) -> Self {
        let forward = camera.forward.unit();
        let right = forward.cross(camera.up).unit();
        Self {
            origin: camera.position,
            forward,
            right,
            up: right.cross(forward),
        }
    }

    /// The observer behind the mirror, who sees directly what this one sees in it.
    pub(crate) fn mirrored(&self, mirror: &Frame) -> Self {
        let normal = mirror.axes[2];
        let turn = |direction: Vec3| direction - normal * (2.0 * direction.dot(normal));
        Self {
            origin: mirror.position + turn(self.origin - mirror.position),
            forward: turn(self.forward),
            right: turn(self.right),
            up: turn(self.up),
        }
    }

    /// Seen from the frame of a geom.
    pub(crate) fn seen_from(&self, frame: &Frame) -> Self {
        Self {
            origin: frame.to_local(self.origin - frame.position),
            forward: frame.to_local(self.forward),
            right: frame.to_local(self.right),
            up: frame.to_local(self.up),
        }
    }

    /// The ray at these tangents. Along it, multiples of its direction are depths.
    pub(crate) fn ray(&self, x: f32, y: f32) -> Vec3 {
        self.forward + self.right * x + self.up * y
    }

    /// [`ray`](Self::ray) for the samples of a pixel.
    pub(crate) fn rays(&self, x: &[f32; SAMPLES], y: &[f32; SAMPLES]) -> Rays<SAMPLES> {
        let component = |forward: f32, right: f32, up: f32| {
            std::array::from_fn(|k| forward + right * x[k] + up * y[k])
        };
        Rays {
            x: component(self.forward.x, self.right.x, self.up.x),
            y: component(self.forward.y, self.right.y, self.up.y),
            z: component(self.forward.z, self.right.z, self.up.z),
        }
    }

    /// Pixels that may show something of the convex hull of `points`.
    pub(crate) fn rect(&self, lens: &Lens, points: &[Vec3]) -> Rect {
        let (mut low, mut high) = ([f32::MAX; 2], [f32::MIN; 2]);
        for &point in points {
            let offset = point - self.origin;
            let depth = offset.dot(self.forward);
            if depth.is_nan() || depth <= 1e-6 {
                return lens.whole();
            }
            let column = (offset.dot(self.right) / depth - lens.corner[0]) / lens.pitch[0];
            let row = (lens.corner[1] - offset.dot(self.up) / depth) / lens.pitch[1];
            for (axis, at) in [column, row].into_iter().enumerate() {
                low[axis] = low[axis].min(at);
                high[axis] = high[axis].max(at);
            }
        }
        let range = |axis: usize, size: usize| {
            let first = (low[axis] - 0.01).floor().max(0.0) as usize;
            let end = ((high[axis] + 0.01).ceil().max(0.0) as usize).min(size);
            [first.min(end), end]
        };
        Rect {
            columns: range(0, lens.columns.len()),
            rows: range(1, lens.rows.len()),
        }
    }
}

/// A part of the picture, ends excluded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Rect {
    pub(crate) columns: [usize; 2],
    pub(crate) rows: [usize; 2],
}
