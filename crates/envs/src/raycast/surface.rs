//! The point of a geom that a pixel shows, and its texture.

use super::mesh::MeshHit;
use super::scene::{Assets, Geom, Shape, Surface, TextureUse};
use super::shape::Rays;
use super::vec3::Vec3;
use super::view::View;

/// A visible point of a geom, in its frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Visible {
    pub(crate) position: Vec3,
    pub(crate) normal: Vec3,
    hit: Option<MeshHit>,
}

impl Visible {
    /// The point that an observer sees at tangents `(x, y)`, farther than depth `near`.
    pub(crate) fn new(
        geom: &Geom,
        assets: &Assets,
        view: &View,
        [x, y]: [f32; 2],
        near: f32,
    ) -> Option<Self> {
        let ray = view.ray(x, y);
        if let Shape::Mesh { index } = geom.shape {
            let mesh = &assets.meshes[index];
            let hit = mesh.hit(view.origin, ray, near)?;
            return Some(Self {
                position: view.origin + ray * hit.distance,
                normal: mesh.normal(&hit),
                hit: Some(hit),
            });
        }
        let depth = match geom.shape {
            // Polygons are lit in the middle of a pixel, even if only other parts of it are theirs.
            Shape::Plane { .. } => -view.origin.z / ray.z,
            shape => shape.enter(&assets.meshes, view.origin, &Rays::one(ray))[0],
        };
        if !depth.is_finite() || depth < near {
            return None;
        }
        let position = view.origin + ray * depth;
        Some(Self {
            position,
            normal: geom.shape.normal(position),
            hit: None,
        })
    }

    /// The colour of the geom's texture here; white without one. A pixel is `pitch` wide and high.
    pub(crate) fn texture(
        &self,
        geom: &Geom,
        assets: &Assets,
        view: &View,
        [x, y]: [f32; 2],
        pitch: [f32; 2],
    ) -> [f32; 3] {
        let Some(used) = geom.material.texture else {
            return [1.0; 3];
        };
        let steps = [[0.0, 0.0], [pitch[0], 0.0], [0.0, -pitch[1]]];
        let rays = steps.map(|[right, up]| view.ray(x + right, y + up));
        if let (Some(hit), Shape::Mesh { index }, Surface::Flat(image)) =
            (&self.hit, geom.shape, &assets.textures[used.index])
        {
            let mesh = &assets.meshes[index];
            let places = rays.map(|ray| mesh.texture(hit.triangle, view.origin, ray));
            if let [Some(at), Some(right), Some(down)] = places {
                return image.sample(at, step(at, right), step(at, down));
            }
        }
        // Neighbouring pixels see points near the tangent plane.
        let height = (self.position - view.origin).dot(self.normal);
        let places = rays.map(|ray| {
            let slope = ray.dot(self.normal);
            if slope == 0.0 {
                self.position
            } else {
                view.origin + ray * (height / slope)
            }
        });
        let half = geom.shape.bounds(&assets.meshes).map(|(_, half)| half);
        let half = half.unwrap_or(Vec3::new(1.0, 1.0, 1.0));
        match &assets.textures[used.index] {
            Surface::Flat(image) => {
                let [at, right, down] = places.map(|place| flat(&used, half, place));
                image.sample(at, step(at, right), step(at, down))
            }
            Surface::Cube(cube) => {
                let [at, right, down] = places.map(|place| around(&used, half, place));
                cube.sample(at, right, down)
            }
        }
    }
}

fn step(from: [f32; 2], to: [f32; 2]) -> [f32; 2] {
    [to[0] - from[0], to[1] - from[1]]
}

/// Where a texture that is laid over x and y is at `place` of a geom with these half sizes.
fn flat(used: &TextureUse, half: Vec3, place: Vec3) -> [f32; 2] {
    let at = |repeat: f32, half: f32, from_edge: f32| {
        let size = if used.uniform || half == 0.0 {
            1.0
        } else {
            half
        };
        0.5 * repeat * from_edge / size
    };
    [
        at(used.repeat[0], half.x, half.x + place.x),
        at(used.repeat[1], half.y, half.y - place.y),
    ]
}

/// Where in a cube around the geom `place` is.
fn around(used: &TextureUse, half: Vec3, place: Vec3) -> Vec3 {
    if used.uniform {
        return place;
    }
    let share = |at: f32, half: f32| if half == 0.0 { at } else { at / half };
    Vec3::new(
        share(place.x, half.x),
        share(place.y, half.y),
        share(place.z, half.z),
    )
}
