//! Planes, which MuJoCo draws as grids of quads.

use super::corners::{Blend, CornerLight, Lighting};
use super::maths::floor;
use super::vec3::Vec3;

/// Most cells along one side.
const CELLS: usize = 200;

/// The grid of a plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Grid([Lines; 2]);

/// The lines of the grid in one direction.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Lines {
    /// Where the first and the last are.
    ends: [f32; 2],
    /// Where the second is.
    second: f32,
    /// Between the second and the last but one.
    pitch: f32,
    cells: usize,
}

impl Grid {
    /// The grid of a plane of these half sizes, seen as far as `far`.
    pub(crate) fn new(half: [f32; 2], spacing: f32, far: f32) -> Self {
        Self(half.map(|half| Lines::new(half, spacing, far)))
    }

    pub(crate) fn corners(&self) -> usize {
        (self.0[0].cells + 1) * (self.0[1].cells + 1)
    }

    /// The corners around a place of the plane, whose light is in `light` then.
    pub(crate) fn blend(
        &self,
        at: [f32; 2],
        lighting: &Lighting<'_>,
        light: &mut CornerLight,
    ) -> Blend {
        let [(i, x), (j, y)] = [0, 1].map(|axis| self.0[axis].cell(at[axis]));
        let across = self.0[0].cells + 1;
        let corner = |i: usize, j: usize| j * across + i;
        // A quad is two triangles that share the diagonal from (1, 0) to (0, 1).
        let (diagonal, x, y, square) = if x + y <= 1.0 {
            ([corner(i + 1, j), corner(i, j + 1)], x, y, corner(i, j))
        } else {
            let other = [corner(i, j + 1), corner(i + 1, j)];
            (other, 1.0 - x, 1.0 - y, corner(i + 1, j + 1))
        };
        let corners = [(square, 1.0 - x - y), (diagonal[0], x), (diagonal[1], y)];
        for (corner, _) in corners {
            light.light(corner, lighting, || {
                let x = self.0[0].line(corner % across);
                let y = self.0[1].line(corner / across);
                (Vec3::new(x, y, 0.0), Vec3::new(0.0, 0.0, 1.0))
            });
        }
        Blend(corners)
    }
}

impl Lines {
    fn new(half: f32, spacing: f32, far: f32) -> Self {
        if half <= 0.0 {
            let reach = 1.05 * far + 2.0 * spacing;
            let pitch = 2.0 * reach / CELLS as f32;
            return Self {
                ends: [-reach, reach],
                second: pitch - reach,
                pitch,
                cells: CELLS,
            };
        }
        let spacing = spacing.max(half / (CELLS - 2) as f32);
        // An even number of full cells, and what is left of the size at both ends.
        let inner = (half / spacing) as usize / 2 * 2;
        let rest = half - inner as f32 * spacing;
        Self {
            ends: [-half, half],
            second: rest - half,
            pitch: 2.0 * spacing,
            cells: inner + 2,
        }
    }

    fn line(&self, index: usize) -> f32 {
        match index {
            0 => self.ends[0],
            index if index == self.cells => self.ends[1],
            index => self.second + self.pitch * (index - 1) as f32,
        }
    }

    /// The cell at `at`, and where in it that is, from 0 to 1.
    fn cell(&self, at: f32) -> (usize, f32) {
        let last = (self.cells - 1) as f32;
        let inner = ((at - self.second) / self.pitch).clamp(-1.0, last);
        let index = (floor(inner) + 1.0).min(last) as usize;
        let (left, right) = (self.line(index), self.line(index + 1));
        let width = right - left;
        let place = if width > 0.0 {
            (at - left) / width
        } else {
            0.0
        };
        (index, place)
    }
}
