//! One scene, prepared for drawing, and the colours of its bodies.

use super::corners::Lighting;
use super::layer::{Layer, Mirror, Target};
use super::light::{Point, add, multiply, saturate, unlit};
use super::prepared::{Prepared, transparent};
use super::scene::{Assets, Geom, Light, Scene, Shape};
use super::shadow::Caster;
use super::surface::Visible;
use super::vec3::Vec3;
use super::view::{Lens, SAMPLES, View};

/// Lights beyond these stay dark, as in OpenGL.
const LIGHTS: usize = 8;

/// What is fixed while one scene is drawn.
pub(super) struct Drawing<'a> {
    pub(super) assets: &'a Assets,
    pub(super) geoms: &'a [Geom],
    pub(super) lights: &'a [Light],
    /// Of the lights that throw shadows, in their order.
    pub(super) casters: Vec<Caster>,
    pub(super) prepared: Vec<Prepared>,
    pub(super) lens: &'a Lens,
    pub(super) view: View,
    pub(super) near: f32,
    pub(super) mirror: Option<Mirror>,
    pub(super) mirrored_view: View,
    /// The plane whose shadows are computed before its pixels.
    pub(super) ground: Option<usize>,
}

impl<'a> Drawing<'a> {
    pub(super) fn new(scene: &'a Scene, assets: &'a Assets, lens: &'a Lens) -> Self {
        let view = View::new(&scene.camera);
        let mut prepared: Vec<_> = scene
            .geoms
            .iter()
            .map(|geom| Prepared::new(geom, &assets.meshes, &view))
            .collect();
        let lights = &scene.lights[..scene.lights.len().min(LIGHTS)];
        let mirror = find_mirror(&scene.geoms, &prepared, &view);
        let mirrored_view = mirror.map_or(view, |mirror| view.mirrored(&mirror.frame));
        for (prepared, geom) in prepared.iter_mut().zip(&scene.geoms) {
            prepared.mirrored = mirrored_view.seen_from(&geom.frame);
        }
        let is_ground = |index: &usize| {
            matches!(scene.geoms[*index].shape, Shape::Plane { .. })
                && !prepared[*index].transparent
        };
        let casters = lights.iter();
        Self {
            assets,
            geoms: &scene.geoms,
            lights,
            casters: casters
                .filter_map(|light| Some(Caster::new(light, light.shadow?)))
                .collect(),
            ground: (0..scene.geoms.len()).find(is_ground),
            prepared,
            lens,
            view,
            near: scene.camera.near,
            mirror,
            mirrored_view,
        }
    }

    pub(super) fn target(&self, index: usize, view: &View, local: &'a View) -> Target<'a>
    where
        Self: 'a,
    {
        Target {
            id: index as u16,
            shape: &self.geoms[index].shape,
            meshes: &self.assets.meshes,
            view: local,
            rect: self.prepared[index].rect(self.lens, view),
        }
    }

    pub(super) fn lighting(&self, index: usize) -> Lighting<'_> {
        Lighting {
            geom: &self.geoms[index],
            lights: self.lights,
            eye: self.view.origin,
        }
    }

    /// Transparent geoms, once from the front and once from the back.
    pub(super) fn blending_order(&self, scene: &Scene) -> Vec<usize> {
        let mut order = transparent(scene, &self.prepared);
        order.extend(order.clone().iter().rev());
        order
    }

    /// The tangents at which a geom is shaded in a pixel: the middle, if it is there, else the middle of the
    /// samples that show it.
    pub(super) fn place(&self, layer: &Layer, local: &View, pixel: usize, geom: u16) -> [f32; 2] {
        let (row, column) = (
            pixel / self.lens.columns.len(),
            pixel % self.lens.columns.len(),
        );
        let middle = [self.lens.middle_columns[column], self.lens.middle_rows[row]];
        let samples = &layer.pixels[pixel].geom;
        if samples.iter().all(|&sample| sample == geom) {
            return middle;
        }
        let shape = &self.geoms[usize::from(geom)];
        if Visible::new(shape, self.assets, local, middle, self.near).is_some() {
            return middle;
        }
        let shown = (0..SAMPLES).filter(|&k| samples[k] == geom);
        let (mut x, mut y, mut count) = (0.0, 0.0, 0.0);
        for k in shown {
            x += self.lens.columns[column][k];
            y += self.lens.rows[row][k];
            count += 1.0;
        }
        [x / count, y / count]
    }

    /// Tangents of the middle of a pixel, and whether all its samples show the geom.
    pub(super) fn middle(&self, layer: &Layer, pixel: usize, geom: u16) -> ([f32; 2], bool) {
        let width = self.lens.columns.len();
        let column = self.lens.middle_columns[pixel % width];
        let middle = [column, self.lens.middle_rows[pixel / width]];
        let samples = &layer.pixels[pixel].geom;
        (middle, samples.iter().all(|&sample| sample == geom))
    }

    /// Whether the geom is drawn with facets, so that samples of a pixel may differ.
    pub(super) fn by_sample(&self, geom: u16) -> bool {
        let shape = self.geoms.get(usize::from(geom)).map(|geom| &geom.shape);
        shape.is_some_and(|shape| {
            !matches!(
                shape,
                Shape::Plane { .. } | Shape::Box { .. } | Shape::Mesh { .. }
            )
        })
    }

    /// Tangents of a sample.
    pub(super) fn sample(&self, pixel: usize, sample: usize) -> [f32; 2] {
        let width = self.lens.columns.len();
        let (row, column) = (pixel / width, pixel % width);
        [
            self.lens.columns[column][sample],
            self.lens.rows[row][sample],
        ]
    }

    /// The colour of an opaque body.
    pub(super) fn body(&self, index: usize, at: [f32; 2]) -> [f32; 3] {
        let geom = &self.geoms[index];
        let view = &self.prepared[index].view;
        let Some(visible) = Visible::new(geom, self.assets, view, at, self.near) else {
            return [0.0; 3];
        };
        let point = self.point(geom, &visible, &self.view);
        let mut plain = unlit(&geom.material, self.lights);
        let mut shadowed = [0.0; 3];
        let mut casters = self.casters.iter();
        for light in self.lights {
            let colour = light.on(&geom.material, &point);
            if light.shadow.is_none() {
                plain = add(plain, colour);
                continue;
            }
            let caster = casters.next();
            let lit = colour != [0.0; 3]
                && !caster.is_some_and(|caster| self.is_dark(caster, index, point.position));
            if lit {
                shadowed = add(shadowed, saturate(colour));
            }
        }
        let texture = visible.texture(geom, self.assets, view, at, self.lens.pitch);
        saturate(multiply(add(saturate(plain), shadowed), texture))
    }

    /// The colour of a geom in all lights, its own colour weakened to a share of `tint`.
    pub(super) fn unshadowed(
        &self,
        index: usize,
        (view, local): (&View, &View),
        at: [f32; 2],
        tint: f32,
    ) -> [f32; 3] {
        let geom = &self.geoms[index];
        let Some(visible) = Visible::new(geom, self.assets, local, at, self.near) else {
            return [0.0; 3];
        };
        let point = self.point(geom, &visible, view);
        let mut material = geom.material;
        for value in &mut material.rgba[..3] {
            *value *= tint;
        }
        let mut colour = unlit(&material, self.lights);
        for light in self.lights {
            colour = add(colour, light.on(&material, &point));
        }
        let texture = visible.texture(geom, self.assets, local, at, self.lens.pitch);
        multiply(saturate(colour), texture)
    }

    fn point(&self, geom: &Geom, visible: &Visible, view: &View) -> Point {
        let position = geom.frame.position + geom.frame.to_world(visible.position);
        Point {
            position,
            normal: geom.frame.to_world(visible.normal),
            to_eye: (view.origin - position).unit(),
        }
    }

    /// Whether `point` of the geom with this index is in a shadow.
    pub(super) fn is_dark(&self, caster: &Caster, index: usize, point: Vec3) -> bool {
        let Some(path) = caster.path(point) else {
            return false;
        };
        self.geoms.iter().enumerate().any(|(other, geom)| {
            let prepared = &self.prepared[other];
            let itself = other == index && geom.shape.is_convex();
            geom.casts_shadow
                && !itself
                && path.passes(prepared.centre, prepared.radius)
                && path.meets(geom, &self.assets.meshes)
        })
    }
}

/// The first plane or box that mirrors, if the observer is in front of it.
fn find_mirror(geoms: &[Geom], prepared: &[Prepared], view: &View) -> Option<Mirror> {
    let (index, geom) = geoms.iter().enumerate().find(|(index, geom)| {
        matches!(geom.shape, Shape::Plane { .. } | Shape::Box { .. })
            && geom.material.reflectance > 0.0
            && !prepared[*index].transparent
    })?;
    let mut frame = geom.frame;
    if let Shape::Box { half } = geom.shape {
        frame.position = frame.position + frame.axes[2] * half.z;
    }
    let view = view.seen_from(&frame);
    (view.origin.z >= 0.0).then_some(Mirror {
        id: index as u16,
        reflectance: geom.material.reflectance,
        frame,
        view,
    })
}
