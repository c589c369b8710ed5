//! Which geom each sample shows.

use super::mesh::Mesh;
use super::scene::Shape;
use super::shape::MISS;
use super::vec3::Frame;
use super::view::{Lens, Rect, SAMPLES, View};

/// No geom.
pub(crate) const NOTHING: u16 = u16::MAX;

/// The nearest geom of every sample.
#[derive(Debug, Default)]
pub(crate) struct Layer {
    /// `[height, width]`
    pub(crate) pixels: Vec<Samples>,
}

/// The samples of a pixel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Samples {
    /// Depth of what is there.
    pub(crate) depth: [f32; SAMPLES],
    /// Index of the geom.
    pub(crate) geom: [u16; SAMPLES],
}

const EMPTY: Samples = Samples {
    depth: [MISS; SAMPLES],
    geom: [NOTHING; SAMPLES],
};

/// A geom to look for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Target<'a> {
    pub(crate) id: u16,
    pub(crate) shape: &'a Shape,
    pub(crate) meshes: &'a [Mesh],
    /// The observer seen from the geom.
    pub(crate) view: &'a View,
    /// Where to look.
    pub(crate) rect: Rect,
}

impl Layer {
    pub(crate) fn clear(&mut self, pixels: usize) {
        self.pixels.clear();
        self.pixels.resize(pixels, EMPTY);
    }

    /// Puts a geom where it is nearer than what is there, beyond `near`.
    pub(crate) fn draw(&mut self, lens: &Lens, target: &Target<'_>, near: f32) {
        target.scan(lens, |index, depth| {
            let there = &mut self.pixels[index];
            for (k, &depth) in depth.iter().enumerate() {
                if depth >= near && depth <= there.depth[k] && depth < MISS {
                    there.depth[k] = depth;
                    there.geom[k] = target.id;
                }
            }
        });
    }

    /// Puts a geom, seen by the observer behind the mirror, where `scene` shows the mirror and the geom is on this
    /// side of it.
    pub(crate) fn draw_mirrored(
        &mut self,
        lens: &Lens,
        target: &Target<'_>,
        scene: &Self,
        mirror: &Mirror,
    ) {
        target.scan(lens, |index, depth| {
            let (there, seen) = (&mut self.pixels[index], &scene.pixels[index]);
            if !seen.geom.contains(&mirror.id) {
                return;
            }
            let width = lens.columns.len();
            let surface = mirror.depth(&lens.columns[index % width], &lens.rows[index / width]);
            for (k, &depth) in depth.iter().enumerate() {
                // The sides of a box do not mirror.
                let shown = (surface[k] - seen.depth[k]).abs() <= 1e-4 * seen.depth[k];
                let front = seen.geom[k] == mirror.id && shown && depth > seen.depth[k];
                if front && depth <= there.depth[k] && depth < MISS {
                    there.depth[k] = depth;
                    there.geom[k] = target.id;
                }
            }
        });
    }
}

/// The one geom of a scene that mirrors.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Mirror {
    pub(crate) id: u16,
    pub(crate) reflectance: f32,
    /// Its surface is where z is 0.
    pub(crate) frame: Frame,
    /// The observer, seen from it.
    pub(crate) view: View,
}

impl Mirror {
    /// Depth of its plane at the samples of a pixel.
    fn depth(&self, x: &[f32; SAMPLES], y: &[f32; SAMPLES]) -> [f32; SAMPLES] {
        let View {
            origin,
            forward,
            right,
            up,
        } = &self.view;
        std::array::from_fn(|k| -origin.z / (forward.z + right.z * x[k] + up.z * y[k]))
    }
}

impl Target<'_> {
    /// Calls `visit` with every pixel's index and the depths at its samples, if any of them is hit.
    fn scan(&self, lens: &Lens, mut visit: impl FnMut(usize, &[f32; SAMPLES])) {
        let width = lens.columns.len();
        for row in self.rect.rows[0]..self.rect.rows[1] {
            for column in self.rect.columns[0]..self.rect.columns[1] {
                let rays = self.view.rays(&lens.columns[column], &lens.rows[row]);
                let depth = self.shape.enter(self.meshes, self.view.origin, &rays);
                if depth.iter().any(|&depth| depth < MISS) {
                    visit(row * width + column, &depth);
                }
            }
        }
    }
}
