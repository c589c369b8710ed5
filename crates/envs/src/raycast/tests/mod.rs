//! Small scenes whose pixels can be computed by hand.

mod forms;
mod light;
mod passes;
mod textures;

use std::sync::Arc;

use super::*;

/// An odd number, so that the middle of the middle pixel is on the axis.
const SIDE: usize = 65;
const MIDDLE: usize = SIDE / 2;

const WHITE: [f32; 4] = [1.0, 1.0, 1.0, 1.0];

/// Shines by itself in these colours, and in no other light.
fn glowing(rgba: [f32; 4]) -> Material {
    Material {
        rgba,
        emission: 1.0,
        specular: 0.0,
        shininess: 0.5,
        reflectance: 0.0,
        texture: None,
    }
}

/// White without highlights.
fn matt() -> Material {
    Material {
        emission: 0.0,
        ..glowing(WHITE)
    }
}

fn geom(shape: Shape, position: [f32; 3], material: Material) -> Geom {
    Geom {
        shape,
        frame: Frame::at(position.into()),
        material,
        class: match shape {
            Shape::Plane { .. } => Class::Floor,
            _ => Class::Body,
        },
        casts_shadow: true,
    }
}

/// Turned so that its z axis points at an observer who looks along x.
fn facing(mut geom: Geom) -> Geom {
    geom.frame.axes = [
        Vec3::new(0.0, -1.0, 0.0),
        Vec3::new(0.0, 0.0, 1.0),
        Vec3::new(-1.0, 0.0, 0.0),
    ];
    geom
}

/// White light along `direction`, without a shadow.
fn sun(direction: [f32; 3]) -> Light {
    Light {
        kind: LightKind::Directional,
        position: Vec3::default(),
        direction: Vec3::from(direction).unit(),
        ambient: [0.0; 3],
        diffuse: [1.0; 3],
        specular: [0.0; 3],
        shadow: None,
    }
}

/// No light at all, but one so that there is none by default.
fn darkness() -> Light {
    Light {
        diffuse: [0.0; 3],
        ..sun([1.0, 0.0, 0.0])
    }
}

/// Seen from the origin along x, z up, 90 degrees wide.
fn scene(geoms: Vec<Geom>, lights: Vec<Light>) -> Scene {
    Scene {
        geoms,
        lights,
        camera: Camera::default(),
    }
}

fn draw(scene: &Scene) -> Picture {
    draw_with(Assets::default(), scene)
}

fn draw_with(assets: Assets, scene: &Scene) -> Picture {
    let mut renderer = Renderer::new(Arc::new(assets), SIDE, SIDE);
    let bytes = renderer.render(scene);
    Picture {
        bytes,
        classes: renderer.classes().to_vec(),
    }
}

struct Picture {
    bytes: Vec<u8>,
    classes: Vec<Class>,
}

impl Picture {
    fn at(&self, row: usize, column: usize) -> [u8; 3] {
        let first = (row * SIDE + column) * 3;
        [
            self.bytes[first],
            self.bytes[first + 1],
            self.bytes[first + 2],
        ]
    }

    fn middle(&self) -> [u8; 3] {
        self.at(MIDDLE, MIDDLE)
    }

    fn class(&self, row: usize, column: usize) -> Class {
        self.classes[row * SIDE + column]
    }

    /// How wide and how high white is through the middle, in tangents.
    fn white(&self) -> [f32; 2] {
        let row = (0..SIDE).map(|column| f32::from(self.at(MIDDLE, column)[0]));
        let column = (0..SIDE).map(|row| f32::from(self.at(row, MIDDLE)[0]));
        let pixel = 2.0 / SIDE as f32;
        [
            row.sum::<f32>() / 255.0 * pixel,
            column.sum::<f32>() / 255.0 * pixel,
        ]
    }
}

fn assert_near(actual: [u8; 3], expected: [f32; 3], what: &str) {
    for c in 0..3 {
        let expected = expected[c].clamp(0.0, 1.0) * 255.0;
        assert!(
            (f32::from(actual[c]) - expected).abs() <= 1.0,
            "{what}: {actual:?} has not {expected}"
        );
    }
}
