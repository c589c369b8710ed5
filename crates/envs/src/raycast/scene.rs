//! What is drawn: geoms, lights and a camera, and the textures and meshes that they use.

use super::mesh::Mesh;
use super::texture::{CubeTexture, Texture};
use super::vec3::{Frame, Vec3};

/// What the pictures of one model share.
#[derive(Debug, Default)]
pub struct Assets {
    /// Textures that materials name by index.
    pub textures: Vec<Surface>,
    /// Meshes that geoms name by index.
    pub meshes: Vec<Mesh>,
    /// Around everything; black without it.
    pub sky: Option<CubeTexture>,
}

/// A texture of a material.
#[derive(Debug)]
pub enum Surface {
    /// An image laid over the geom's x and y, or over a mesh's own coordinates.
    Flat(Texture),
    /// Six images around the geom.
    Cube(CubeTexture),
}

/// One moment.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Scene {
    /// In drawing order.
    pub geoms: Vec<Geom>,
    /// All lights.
    pub lights: Vec<Light>,
    /// From where it is seen.
    pub camera: Camera,
}

/// One body of a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Geom {
    /// Its form.
    pub shape: Shape,
    /// Its place.
    pub frame: Frame,
    /// Its look.
    pub material: Material,
    /// What it counts as in the class picture.
    pub class: Class,
    /// Whether it throws a shadow.
    pub casts_shadow: bool,
}

/// The form of a geom around its own origin, lengths in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// The rectangle `|x| <= half[0], |y| <= half[1]` at z = 0; zero stands for endless. It is lit at the corners
    /// of a grid with lines `2 * spacing` apart, as MuJoCo's is, and the light of other points is interpolated.
    Plane {
        /// Half sizes.
        half: [f32; 2],
        /// Half the distance between grid lines.
        spacing: f32,
    },
    /// A ball.
    Sphere {
        /// Its radius.
        radius: f32,
    },
    /// A cylinder along z with half balls at both ends.
    Capsule {
        /// Of the cylinder and of the balls.
        radius: f32,
        /// Half the length without the balls.
        half_length: f32,
    },
    /// A ball with an own radius along every axis.
    Ellipsoid {
        /// The radii.
        radii: Vec3,
    },
    /// A closed cylinder along z.
    Cylinder {
        /// Its radius.
        radius: f32,
        /// Half its length.
        half_length: f32,
    },
    /// A box.
    Box {
        /// Half sizes.
        half: Vec3,
    },
    /// Triangles.
    Mesh {
        /// Index in [`Assets::meshes`].
        index: usize,
    },
}

/// How a surface looks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Red, green, blue and opacity in `[0, 1]`.
    pub rgba: [f32; 4],
    /// Share of its colour that shines by itself.
    pub emission: f32,
    /// Strength of highlights.
    pub specular: f32,
    /// Sharpness of highlights: a 128th of Blinn's exponent.
    pub shininess: f32,
    /// Share of what is mirrored: of a plane, or of the top of a box, the first such geom of a scene alone.
    pub reflectance: f32,
    /// The texture that multiplies its colour.
    pub texture: Option<TextureUse>,
}

/// A texture on a material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TextureUse {
    /// Index in [`Assets::textures`].
    pub index: usize,
    /// Repetitions along x and y: per metre times two if `uniform`, else over the geom.
    pub repeat: [f32; 2],
    /// Whether the texture keeps its size on geoms of different size.
    pub uniform: bool,
}

/// A source of light, colours red, green and blue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Light {
    /// Parallel rays or a cone.
    pub kind: LightKind,
    /// Where it is; for the shadow alone if its rays are parallel.
    pub position: Vec3,
    /// Where it shines, a unit vector.
    pub direction: Vec3,
    /// Light from everywhere.
    pub ambient: [f32; 3],
    /// Light on matt surfaces.
    pub diffuse: [f32; 3],
    /// Light in highlights.
    pub specular: [f32; 3],
    /// If it throws shadows: how far from its axis they reach, in metres for parallel rays, as a tangent for
    /// a cone.
    pub shadow: Option<f32>,
}

/// Form of a light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LightKind {
    /// Parallel rays.
    Directional,
    /// A cone.
    Spot {
        /// Cosine of the angle between axis and edge.
        cos_cutoff: f32,
        /// Power of the cosine with which it weakens towards the edge.
        exponent: f32,
        /// Constant, linear and square term of its weakening with distance.
        attenuation: [f32; 3],
    },
}

/// The observer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Where it is.
    pub position: Vec3,
    /// Where it looks, a unit vector.
    pub forward: Vec3,
    /// What is up in the picture, a unit vector.
    pub up: Vec3,
    /// Distance of the nearest thing that is seen.
    pub near: f32,
    /// Distance of the farthest.
    pub far: f32,
    /// Horizontal centre of the view, in tangents.
    pub centre: f32,
    /// Tangents of the lower and upper edge of the view. The sides follow from the picture's form.
    pub vertical: [f32; 2],
}

impl Default for Camera {
    /// At the origin, along x, 90 degrees high.
    fn default() -> Self {
        Self {
            position: Vec3::default(),
            forward: Vec3::new(1.0, 0.0, 0.0),
            up: Vec3::new(0.0, 0.0, 1.0),
            near: 0.01,
            far: 100.0,
            centre: 0.0,
            vertical: [-1.0, 1.0],
        }
    }
}

/// What a pixel shows mostly.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Class {
    /// The sky, or nothing.
    Background = 0,
    /// The floor, or another plane.
    Floor = 1,
    /// Everything else.
    Body = 2,
}
