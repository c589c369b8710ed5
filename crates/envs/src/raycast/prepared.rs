//! What is known of a geom before any of its pixels is drawn.

use super::mesh::Mesh;
use super::scene::{Geom, Scene, Shape};
use super::vec3::Vec3;
use super::view::{Lens, Rect, View};

/// A geom that is less opaque than this is drawn after all others.
const OPAQUE: f32 = 0.995;
/// How much of a plane's opacity is left where it is seen from behind.
const FROM_BEHIND: f32 = 0.3;

/// A geom of a scene, seen by its observer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Prepared {
    /// The observer, seen from the geom.
    pub(crate) view: View,
    /// The observer behind the mirror, seen from the geom.
    pub(crate) mirrored: View,
    /// Corners of a box around it, in the world, unless it is endless.
    pub(crate) corners: Option<[Vec3; 8]>,
    /// A ball around it.
    pub(crate) centre: Vec3,
    pub(crate) radius: f32,
    /// Opacity, and whether it is drawn after all that is opaque.
    pub(crate) alpha: f32,
    pub(crate) transparent: bool,
}

impl Prepared {
    pub(crate) fn new(geom: &Geom, meshes: &[Mesh], view: &View) -> Self {
        let local = view.seen_from(&geom.frame);
        let bounds = geom.shape.bounds(meshes);
        let corners = bounds.map(|(centre, half)| {
            std::array::from_fn(|index| {
                let sign = |bit: usize| if index >> bit & 1 == 0 { -1.0 } else { 1.0 };
                let corner = centre + half.scale(Vec3::new(sign(0), sign(1), sign(2)));
                geom.frame.position + geom.frame.to_world(corner)
            })
        });
        let behind = matches!(geom.shape, Shape::Plane { .. }) && local.origin.z < 0.0;
        let alpha = geom.material.rgba[3] * if behind { FROM_BEHIND } else { 1.0 };
        let (centre, half) = bounds.unwrap_or_default();
        Self {
            view: local,
            mirrored: local,
            corners,
            centre: geom.frame.position + geom.frame.to_world(centre),
            radius: bounds.map_or(f32::INFINITY, |_| half.norm()),
            alpha,
            transparent: behind || alpha < OPAQUE,
        }
    }

    /// Pixels in which `view` may see it.
    pub(crate) fn rect(&self, lens: &Lens, view: &View) -> Rect {
        match &self.corners {
            Some(corners) => view.rect(lens, corners),
            None => view.rect(lens, &[view.origin]),
        }
    }
}

/// Indices of the geoms that are not opaque, the nearest first; planes count as far away.
pub(crate) fn transparent(scene: &Scene, prepared: &[Prepared]) -> Vec<usize> {
    let eye = scene.camera.position;
    let distance = |index: usize| match scene.geoms[index].shape {
        Shape::Plane { .. } => f32::MAX,
        _ => (scene.geoms[index].frame.position - eye).norm() - prepared[index].radius,
    };
    let indices = 0..scene.geoms.len();
    let mut order: Vec<usize> = indices
        .filter(|&index| prepared[index].transparent)
        .collect();
    order.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)));
    order
}
