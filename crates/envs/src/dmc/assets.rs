//! Textures and meshes of a model, for the renderer.

use mujoco_rs::prelude::*;

use super::ControlError;
use super::physics::Physics;
use crate::raycast::{Assets, CubeTexture, Mesh, Surface, Texture, Triangle, Vec3};

/// What is painted green, so that a video can be put in its place: what DMC-GB's backgrounds do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Recolour {
    /// Nothing.
    #[default]
    None,
    /// The sky: `video_easy`.
    Skybox,
    /// The sky and the checkered floor: `video_hard`.
    SkyboxAndGrid,
}

/// (.2, .8, .2) in bytes. MuJoCo's own gradient between equal colours is one less in 2 % of texels, by rounding,
/// which the first mipmap smooths away.
const GREEN: [u8; 3] = [51, 204, 51];
/// The name of the floor's texture in every model of the suite.
const GRID: &str = "grid";

/// The assets of the model in `physics`.
pub(super) fn load(physics: &Physics, recolour: Recolour) -> Result<Assets, ControlError> {
    let model = physics.model();
    let grid = model.name_to_id(MjtObjBase::mjOBJ_TEXTURE, GRID);
    let mut assets = Assets::default();
    for (id, &kind) in model.tex_type().iter().enumerate() {
        let green = match recolour {
            Recolour::None => false,
            Recolour::Skybox => kind == MjtTexture::mjTEXTURE_SKYBOX,
            Recolour::SkyboxAndGrid => kind == MjtTexture::mjTEXTURE_SKYBOX || grid == Some(id),
        };
        let surface = if green {
            green_surface(kind)
        } else {
            surface(physics, id, kind)?
        };
        match surface {
            // Only the first sky is drawn.
            Surface::Cube(cube) if kind == MjtTexture::mjTEXTURE_SKYBOX && assets.sky.is_none() => {
                assets.sky = Some(cube);
                // Keeps the index of those that follow.
                assets.textures.push(Surface::Flat(Texture::plain(GREEN)));
            }
            surface => assets.textures.push(surface),
        }
    }
    let meshes = 0..model.mesh_vertadr().len();
    assets.meshes = meshes.map(|id| mesh(model, id)).collect();
    Ok(assets)
}

fn green_surface(kind: MjtTexture) -> Surface {
    if kind == MjtTexture::mjTEXTURE_2D {
        Surface::Flat(Texture::plain(GREEN))
    } else {
        Surface::Cube(CubeTexture::plain(GREEN))
    }
}

fn surface(physics: &Physics, id: usize, kind: MjtTexture) -> Result<Surface, ControlError> {
    let model = physics.model();
    let bytes = model.load_texture(id);
    let bytes = bytes.map_err(|error| physics.unusable(error.to_string()))?;
    let width = model.tex_width()[id] as usize;
    let height = model.tex_height()[id] as usize;
    let channels = model.tex_nchannel()[id] as usize;
    let complete = width > 0 && height > 0 && bytes.len() == width * height * channels;
    if !complete || channels < 3 {
        let size = format!("{width} x {height} x {channels}");
        return Err(physics.unusable(format!("texture {id} of {size} is not an image")));
    }
    let texels: Vec<[u8; 3]> = bytes
        .chunks_exact(channels)
        .map(|texel| [texel[0], texel[1], texel[2]])
        .collect();
    if kind == MjtTexture::mjTEXTURE_2D {
        return Ok(Surface::Flat(Texture::new(width, height, texels)));
    }
    // Six faces one below the other, or one for all sides.
    let face = width * width;
    let faces = texels.len() / face;
    if faces != 1 && faces != 6 {
        return Err(physics.unusable(format!("texture {id} has {faces} faces, not one or six")));
    }
    Ok(Surface::Cube(CubeTexture::new(std::array::from_fn(
        |side| {
            let first = side % faces * face;
            Texture::new(width, width, texels[first..first + face].to_vec())
        },
    ))))
}

/// A corner's normal that turns away from its triangle more than this (a cosine) is an edge: it is not used.
const SMOOTH: f32 = 0.8;

fn mesh(model: &MjModel, id: usize) -> Mesh {
    let vertex = model.mesh_vertadr()[id];
    let normal = model.mesh_normaladr()[id];
    let texture = model.mesh_texcoordadr()[id];
    let first = model.mesh_faceadr()[id] as usize;
    let faces = first..first + model.mesh_facenum()[id] as usize;
    let triangles = faces.map(|face| {
        let corners = model.mesh_face()[face]
            .map(|corner| Vec3::from(model.mesh_vert()[(vertex + corner) as usize]));
        let normals = model.mesh_facenormal()[face]
            .map(|corner| Vec3::from(model.mesh_normal()[(normal + corner) as usize]));
        let texture = (texture >= 0).then(|| {
            model.mesh_facetexcoord()[face]
                .map(|corner| model.mesh_texcoord()[(texture + corner) as usize])
        });
        let triangle = Triangle {
            corners,
            normals,
            texture,
        };
        if texture.is_some() {
            triangle
        } else {
            triangle.with_edges(SMOOTH)
        }
    });
    Mesh::new(triangles.collect())
}
