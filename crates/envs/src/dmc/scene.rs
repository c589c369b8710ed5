//! Pictures of a task: from MuJoCo's abstract scene to the renderer's.

use std::fmt;
use std::sync::Arc;

use mujoco_rs::prelude::*;

use super::assets::{self, Recolour};
use super::{ControlError, ControlTask};
use crate::raycast::{
    Assets, Camera, Class, Frame, Geom, Light, LightKind, Material, Renderer, Scene, Shape,
    TextureUse, Vec3,
};

/// Room for geoms: as many as dm_control allows.
const MAX_GEOMS: usize = 1000;
/// MuJoCo's limit to the angle over which a spot throws shadows, degrees.
const MAX_SHADOW_ANGLE: f32 = 160.0;

/// Draws a task as `physics.render` of dm_control does, through the camera [`ControlTask::CAMERA_ID`].
pub struct SceneRenderer {
    abstract_scene: MjvScene,
    options: MjvOption,
    perturbation: MjvPerturb,
    camera: MjvCamera,
    shadows: ShadowReach,
    scene: Scene,
    renderer: Renderer,
}

/// How far lights throw shadows in a model.
#[derive(Debug, Clone, Copy)]
struct ShadowReach {
    /// From the axis of parallel light, metres.
    distance: f32,
    /// Share of a spot's angle.
    share: f32,
}

impl SceneRenderer {
    /// A renderer of pictures with `(height, width)` pixels.
    ///
    /// # Errors
    /// If the model has a texture that cannot be read.
    pub fn new(
        task: &ControlTask,
        size: (usize, usize),
        recolour: Recolour,
    ) -> Result<Self, ControlError> {
        Ok(Self::with_assets(task, size, Self::assets(task, recolour)?))
    }

    /// Textures and meshes of a task, some 20 MB, which renderers of the same task can share.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn assets(task: &ControlTask, recolour: Recolour) -> Result<Arc<Assets>, ControlError> {
        Ok(Arc::new(assets::load(&task.physics, recolour)?))
    }

    /// [`new`](Self::new) with the [`assets`](Self::assets) of a task of the same model.
    pub fn with_assets(task: &ControlTask, size: (usize, usize), assets: Arc<Assets>) -> Self {
        let model = task.model();
        let map = &model.ffi().vis.map;
        Self {
            abstract_scene: MjvScene::new(model, MAX_GEOMS),
            options: MjvOption::default(),
            perturbation: MjvPerturb::default(),
            camera: MjvCamera::new_fixed(ControlTask::CAMERA_ID),
            shadows: ShadowReach {
                distance: model.ffi().stat.extent as f32 * map.shadowclip,
                share: map.shadowscale,
            },
            scene: Scene::default(),
            renderer: Renderer::new(assets, size.0, size.1),
        }
    }

    /// The task's present state: `[height, width, 3]` red, green and blue.
    pub fn render(&mut self, task: &mut ControlTask) -> Vec<u8> {
        self.update(task);
        self.renderer.render(&self.scene)
    }

    /// [`render`](Self::render) into memory that is there.
    ///
    /// # Panics
    /// If that is not `height * width * 3` bytes.
    pub fn render_into(&mut self, task: &mut ControlTask, picture: &mut [u8]) {
        self.update(task);
        self.renderer.render_into(&self.scene, picture);
    }

    /// What each pixel of the last picture shows, `[height, width]`.
    pub fn classes(&self) -> &[Class] {
        self.renderer.classes()
    }

    /// What the last picture was drawn from.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    fn update(&mut self, task: &mut ControlTask) {
        self.abstract_scene.update(
            task.data_mut(),
            &self.options,
            &self.perturbation,
            &mut self.camera,
        );
        let (from, to) = (&self.abstract_scene, &mut self.scene);
        to.geoms.clear();
        to.geoms.extend(from.geoms().iter().filter_map(geom));
        to.lights.clear();
        let lights = from.lights().iter();
        to.lights
            .extend(lights.map(|from| light(from, self.shadows)));
        to.camera = camera(from.camera());
    }
}

impl fmt::Debug for SceneRenderer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SceneRenderer")
            .field("scene", &self.scene)
            .field("renderer", &self.renderer)
            .finish_non_exhaustive()
    }
}

/// The geom, if the renderer knows its form.
fn geom(from: &MjvGeom) -> Option<Geom> {
    const PLANE: i32 = MjtGeom::mjGEOM_PLANE as i32;
    const SPHERE: i32 = MjtGeom::mjGEOM_SPHERE as i32;
    const CAPSULE: i32 = MjtGeom::mjGEOM_CAPSULE as i32;
    const ELLIPSOID: i32 = MjtGeom::mjGEOM_ELLIPSOID as i32;
    const CYLINDER: i32 = MjtGeom::mjGEOM_CYLINDER as i32;
    const BOX: i32 = MjtGeom::mjGEOM_BOX as i32;
    const MESH: i32 = MjtGeom::mjGEOM_MESH as i32;
    let [x, y, z] = from.size;
    let shape = match from.type_ {
        PLANE => Shape::Plane {
            half: [x, y],
            spacing: z,
        },
        SPHERE => Shape::Sphere { radius: x },
        CAPSULE => Shape::Capsule {
            radius: x,
            half_length: z,
        },
        ELLIPSOID => Shape::Ellipsoid {
            radii: from.size.into(),
        },
        CYLINDER => Shape::Cylinder {
            radius: x,
            half_length: z,
        },
        BOX => Shape::Box {
            half: from.size.into(),
        },
        MESH => Shape::Mesh {
            // Odd numbers are those of convex hulls.
            index: usize::try_from(from.dataid).ok()? / 2,
        },
        _ => return None,
    };
    let axis = |k: usize| Vec3::new(from.mat[k], from.mat[3 + k], from.mat[6 + k]);
    Some(Geom {
        shape,
        frame: Frame {
            position: from.pos.into(),
            axes: [axis(0), axis(1), axis(2)],
        },
        material: Material {
            rgba: from.rgba,
            emission: from.emission,
            specular: from.specular,
            shininess: from.shininess,
            reflectance: from.reflectance,
            texture: usize::try_from(from.texid).ok().map(|index| TextureUse {
                index,
                repeat: from.texrepeat,
                uniform: from.texuniform != 0,
            }),
        },
        class: match from.type_ {
            PLANE => Class::Floor,
            _ => Class::Body,
        },
        casts_shadow: from.category != MjtCatBit::mjCAT_DECOR as i32,
    })
}

fn light(from: &MjvLight, shadows: ShadowReach) -> Light {
    let directional = from.type_ == MjtLightType::mjLIGHT_DIRECTIONAL as i32;
    let (kind, reach) = if directional {
        (LightKind::Directional, shadows.distance)
    } else {
        let angle = (2.0 * from.cutoff * shadows.share).min(MAX_SHADOW_ANGLE);
        let kind = LightKind::Spot {
            cos_cutoff: cosine(from.cutoff),
            exponent: from.exponent,
            attenuation: from.attenuation,
        };
        let half = 0.5 * angle;
        (kind, cosine(90.0 - half) / cosine(half))
    };
    Light {
        kind,
        position: from.pos.into(),
        direction: from.dir.into(),
        ambient: from.ambient,
        diffuse: from.diffuse,
        specular: from.specular,
        shadow: (from.castshadow != 0).then_some(reach),
    }
}

/// Of an angle in degrees; single precision hides the differences between C libraries.
fn cosine(degrees: f32) -> f32 {
    f64::from(degrees).to_radians().cos() as f32
}

/// One camera in the middle of MuJoCo's two, which are for two eyes.
fn camera([left, right]: &[MjvGLCamera; 2]) -> Camera {
    let middle = |a: [f32; 3], b: [f32; 3]| (Vec3::from(a) + Vec3::from(b)) * 0.5;
    let near = left.frustum_near;
    Camera {
        position: middle(left.pos, right.pos),
        forward: middle(left.forward, right.forward),
        up: middle(left.up, right.up),
        near,
        far: left.frustum_far,
        centre: 0.5 * (left.frustum_center + right.frustum_center) / near,
        vertical: [left.frustum_bottom / near, left.frustum_top / near],
    }
}
