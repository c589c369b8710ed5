//! Planes, which MuJoCo draws as grids of quads and lights at the corners of these.

use super::light::{Point, add, saturate, unlit};
use super::maths::floor;
use super::scene::{Geom, Light, Shape};
use super::vec3::Vec3;

/// Most cells along one side.
const CELLS: usize = 200;

/// The light on a plane's corners, computed where it is needed.
#[derive(Debug, Default)]
pub(crate) struct FloorLight {
    lines: [Lines; 2],
    /// Values of each corner: the light without shadows, then every light with shadows.
    values: Vec<[f32; 3]>,
    /// Whether each corner's values are those of this scene.
    known: Vec<bool>,
    per_corner: usize,
}

/// The lines of the grid in one direction.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Lines {
    /// Where the first and the last are.
    ends: [f32; 2],
    /// Where the second is.
    second: f32,
    /// Between the second and the last but one.
    pitch: f32,
    cells: usize,
}

/// Three corners around a place and their weights.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Blend([(usize, f32); 3]);

/// What corners are lit by.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Lighting<'a> {
    pub(crate) geom: &'a Geom,
    pub(crate) lights: &'a [Light],
    pub(crate) eye: Vec3,
}

impl FloorLight {
    /// Prepares for another scene, seen as far as `far`.
    pub(crate) fn start(&mut self, lighting: &Lighting<'_>, far: f32) {
        if let Shape::Plane { half, spacing } = lighting.geom.shape {
            self.lines = half.map(|half| Lines::new(half, spacing, far));
        }
        let shadows = lighting
            .lights
            .iter()
            .filter(|light| light.shadow.is_some());
        self.per_corner = 1 + shadows.count();
        let corners = (self.lines[0].cells + 1) * (self.lines[1].cells + 1);
        self.known.clear();
        self.known.resize(corners, false);
        self.values.resize(corners * self.per_corner, [0.0; 3]);
    }

    /// The corners around a place of the plane.
    pub(crate) fn blend(&mut self, at: [f32; 2], lighting: &Lighting<'_>) -> Blend {
        let [(i, x), (j, y)] = [0, 1].map(|axis| self.lines[axis].cell(at[axis]));
        let across = self.lines[0].cells + 1;
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
            if !self.known[corner] {
                self.light(corner, lighting);
            }
        }
        Blend(corners)
    }

    /// The light there: 0 is that without shadows, from 1 on those with shadows follow.
    pub(crate) fn value(&self, blend: &Blend, which: usize) -> [f32; 3] {
        std::array::from_fn(|c| {
            let share = |(corner, weight): (usize, f32)| {
                self.values[corner * self.per_corner + which][c] * weight
            };
            share(blend.0[0]) + share(blend.0[1]) + share(blend.0[2])
        })
    }

    fn light(&mut self, corner: usize, lighting: &Lighting<'_>) {
        let across = self.lines[0].cells + 1;
        let [x, y] = [(0, corner % across), (1, corner / across)]
            .map(|(axis, index)| self.lines[axis].line(index));
        let frame = &lighting.geom.frame;
        let position = frame.position + frame.to_world(Vec3::new(x, y, 0.0));
        let point = Point {
            position,
            normal: frame.axes[2],
            to_eye: (lighting.eye - position).unit(),
        };
        let material = &lighting.geom.material;
        let values = &mut self.values[corner * self.per_corner..][..self.per_corner];
        let mut plain = unlit(material, lighting.lights);
        let mut next = 1;
        for light in lighting.lights {
            let colour = light.on(material, &point);
            if light.shadow.is_some() {
                values[next] = saturate(colour);
                next += 1;
            } else {
                plain = add(plain, colour);
            }
        }
        values[0] = saturate(plain);
        self.known[corner] = true;
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
