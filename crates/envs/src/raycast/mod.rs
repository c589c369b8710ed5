//! A ray-caster that draws what MuJoCo's classic OpenGL renderer draws, on the CPU alone.
//!
//! A [`Scene`] is plain data: nothing here knows MuJoCo. For each geom its pixels are found by projecting a box
//! around it, and in them each of four samples per pixel asks the form itself where its ray enters. The colours
//! however are those of the polygons that MuJoCo would draw, lit at their corners. The lights, the order of passes
//! and the quirks are those of MuJoCo's renderer too, because agents are trained on one and judged on the other.
//!
//! Not drawn: height fields, soft bodies, lines and arrows, haze and fog, and reflections of transparent geoms.
//! Mirrored and transparent bodies, boxes and meshes are lit in each pixel instead of at corners. Meshes are for
//! a few hundred triangles: every ray asks all of them.
//!
//! The picture depends on the scene alone. No function is used whose result is up to the machine's C library.

mod corners;
mod drawing;
mod facet;
mod floor;
mod layer;
mod light;
mod maths;
mod mesh;
mod prepared;
mod renderer;
mod scene;
mod shadow;
mod shape;
mod sky;
mod surface;
#[cfg(test)]
mod tests;
mod texture;
mod vec3;
mod view;

pub use mesh::{Mesh, Triangle};
pub use renderer::Renderer;
pub use scene::{
    Assets, Camera, Class, Geom, Light, LightKind, Material, Scene, Shape, Surface, TextureUse,
};
pub use texture::{CubeTexture, Texture};
pub use vec3::{Frame, Vec3};
