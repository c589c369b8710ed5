//! Light at the corners of polygons, between which OpenGL interpolates.

use super::light::{Point, add, saturate, unlit};
use super::scene::{Geom, Light};
use super::vec3::Vec3;

/// The light on a geom's corners, computed where it is needed.
#[derive(Debug, Default)]
pub(crate) struct CornerLight {
    /// Values of each corner: the light without shadows, then every light with shadows.
    values: Vec<[f32; 3]>,
    /// Whether each corner's values are those of this scene.
    known: Vec<bool>,
    per_corner: usize,
}

/// Three corners around a place and their weights.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Blend(pub(crate) [(usize, f32); 3]);

/// What corners are lit by.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Lighting<'a> {
    pub(crate) geom: &'a Geom,
    pub(crate) lights: &'a [Light],
    pub(crate) eye: Vec3,
}

impl CornerLight {
    /// Prepares for another scene.
    pub(crate) fn start(&mut self, corners: usize, lights: &[Light]) {
        let shadows = lights.iter().filter(|light| light.shadow.is_some());
        self.per_corner = 1 + shadows.count();
        self.known.clear();
        self.known.resize(corners, false);
        self.values.resize(corners * self.per_corner, [0.0; 3]);
    }

    /// The light at a place: 0 is that without shadows, from 1 on those with shadows follow.
    pub(crate) fn value(&self, blend: &Blend, which: usize) -> [f32; 3] {
        std::array::from_fn(|c| {
            let share = |(corner, weight): (usize, f32)| {
                self.values[corner * self.per_corner + which][c] * weight
            };
            share(blend.0[0]) + share(blend.0[1]) + share(blend.0[2])
        })
    }

    /// Makes sure that a corner's light is known, whose position and normal in the geom's frame `surface` tells.
    pub(crate) fn light(
        &mut self,
        corner: usize,
        lighting: &Lighting<'_>,
        surface: impl FnOnce() -> (Vec3, Vec3),
    ) {
        if self.known[corner] {
            return;
        }
        let (position, normal) = surface();
        let frame = &lighting.geom.frame;
        let position = frame.position + frame.to_world(position);
        let point = Point {
            position,
            normal: frame.to_world(normal),
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
