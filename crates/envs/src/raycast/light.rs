//! The light of OpenGL's fixed pipeline: Blinn's highlights with the observer at a place.

use super::maths::power;
use super::scene::{Light, LightKind, Material};
use super::vec3::Vec3;

/// A point to be lit.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Point {
    pub(crate) position: Vec3,
    /// Outwards, a unit vector.
    pub(crate) normal: Vec3,
    /// Towards the observer, a unit vector.
    pub(crate) to_eye: Vec3,
}

/// Colour that a surface has without any of `lights`: what it emits, and a weak light where a scene has none.
pub(crate) fn unlit(material: &Material, lights: &[Light]) -> [f32; 3] {
    let ambient = if lights.is_empty() { 0.3 } else { 0.0 };
    std::array::from_fn(|c| material.rgba[c] * (material.emission + ambient))
}

impl Light {
    /// Colour that the light gives to a surface at `point`, nothing being between them.
    pub(crate) fn on(&self, material: &Material, point: &Point) -> [f32; 3] {
        let (to_light, strength) = self.reach(point.position);
        if strength <= 0.0 {
            return [0.0; 3];
        }
        let facing = point.normal.dot(to_light);
        let mut highlight = 0.0;
        if facing > 0.0 {
            let half = (to_light + point.to_eye).unit();
            let cosine = point.normal.dot(half).clamp(0.0, 1.0);
            highlight = material.specular * power(cosine, material.shininess * 128.0);
        }
        let matt = facing.max(0.0);
        std::array::from_fn(|c| {
            let colour = material.rgba[c] * (self.ambient[c] + self.diffuse[c] * matt);
            strength * (colour + self.specular[c] * highlight)
        })
    }

    /// Direction from `position` to the light, and how strong it is there.
    fn reach(&self, position: Vec3) -> (Vec3, f32) {
        match self.kind {
            LightKind::Directional => (-self.direction, 1.0),
            LightKind::Spot {
                cos_cutoff,
                exponent,
                attenuation: [constant, linear, square],
            } => {
                let offset = self.position - position;
                let distance = offset.norm();
                let to_light = offset.unit();
                let cosine = -to_light.dot(self.direction);
                if cosine < cos_cutoff {
                    return (to_light, 0.0);
                }
                let weakening = constant + distance * (linear + distance * square);
                let strength = power(cosine.clamp(0.0, 1.0), exponent) / weakening;
                (to_light, strength)
            }
        }
    }
}

/// Adds colours.
pub(crate) fn add(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|c| a[c] + b[c])
}

/// Multiplies colours.
pub(crate) fn multiply(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|c| a[c] * b[c])
}

/// No more than white.
pub(crate) fn saturate(colour: [f32; 3]) -> [f32; 3] {
    colour.map(|value| value.clamp(0.0, 1.0))
}
