//! The order of drawing.

use std::sync::Arc;

use super::corners::CornerLight;
use super::drawing::Drawing;
use super::facet::{CORNERS, Facet};
use super::floor::Grid;
use super::layer::{Layer, NOTHING};
use super::light::{add, multiply, saturate};
use super::scene::{Assets, Class, Scene, Shape};
use super::sky::Sky;
use super::surface::Visible;
use super::view::{Lens, SAMPLES};

/// Draws scenes of one model, all of the same size.
///
/// Nothing of a scene is left for the next one but memory and the sky, which is computed again when the observer
/// turns.
#[derive(Debug)]
pub struct Renderer {
    assets: Arc<Assets>,
    width: usize,
    height: usize,
    sky: Sky,
    scene: Layer,
    mirrored: Layer,
    /// Of the ground in the middle of each pixel, `[height, width]`, one bit per light that throws shadows.
    shadows: Vec<u8>,
    /// Of the geom with the same index.
    lights: Vec<CornerLight>,
    /// Of the geom with the same index, if it is a plane.
    grids: Vec<Option<Grid>>,
    colours: Vec<[f32; 3]>,
    classes: Vec<Class>,
}

impl Renderer {
    /// A renderer of pictures with `height` rows and `width` columns.
    pub fn new(assets: Arc<Assets>, height: usize, width: usize) -> Self {
        Self {
            assets,
            width,
            height,
            sky: Sky::default(),
            scene: Layer::default(),
            mirrored: Layer::default(),
            shadows: Vec::new(),
            lights: Vec::new(),
            grids: Vec::new(),
            colours: Vec::new(),
            classes: vec![Class::Background; width * height],
        }
    }

    /// Draws the scene: `[height, width, 3]` red, green and blue, the upper left pixel first.
    ///
    /// # Panics
    /// If the scene names a texture or mesh that is not there, or has more than 65,535 geoms.
    pub fn render(&mut self, scene: &Scene) -> Vec<u8> {
        let mut picture = vec![0; self.width * self.height * 3];
        self.render_into(scene, &mut picture);
        picture
    }

    /// [`render`](Self::render) into memory that is there.
    ///
    /// # Panics
    /// As there, and if that is not `height * width * 3` bytes.
    pub fn render_into(&mut self, scene: &Scene, picture: &mut [u8]) {
        assert_eq!(
            picture.len(),
            self.width * self.height * 3,
            "bytes of the picture"
        );
        assert!(
            scene.geoms.len() <= usize::from(NOTHING),
            "a scene of {} geoms is too large",
            scene.geoms.len()
        );
        let assets = Arc::clone(&self.assets);
        let lens = Lens::new(&scene.camera, self.width, self.height);
        let drawing = Drawing::new(scene, &assets, &lens);
        self.sky.look(&assets, &drawing.view, &lens);
        self.see(&drawing);
        self.shade(&drawing, scene.camera.far);
        for index in drawing.blending_order(scene) {
            self.blend(&drawing, index);
        }
        for (bytes, colour) in picture.as_chunks_mut::<3>().0.iter_mut().zip(&self.colours) {
            *bytes = colour.map(|value| (value * 255.0 + 0.5) as u8);
        }
    }

    /// What each pixel of the last picture shows mostly, `[height, width]`.
    pub fn classes(&self) -> &[Class] {
        &self.classes
    }

    /// Rows and columns of a picture.
    pub fn size(&self) -> (usize, usize) {
        (self.height, self.width)
    }

    /// Finds the geom of every sample, in the scene and in its mirror, and the shadows on the ground.
    fn see(&mut self, drawing: &Drawing<'_>) {
        self.scene.clear(self.width * self.height);
        for (index, prepared) in drawing.prepared.iter().enumerate() {
            if !prepared.transparent {
                let target = drawing.target(index, &drawing.view, &prepared.view);
                self.scene.draw(drawing.lens, &target, drawing.near);
            }
        }
        if let Some(mirror) = &drawing.mirror {
            self.mirrored.clear(self.width * self.height);
            for (index, prepared) in drawing.prepared.iter().enumerate() {
                if prepared.transparent || index == usize::from(mirror.id) {
                    continue;
                }
                let view = &drawing.mirrored_view;
                let target = drawing.target(index, view, &prepared.mirrored);
                self.mirrored
                    .draw_mirrored(drawing.lens, &target, &self.scene, mirror);
            }
        }
        self.shadows.clear();
        self.shadows.resize(self.width * self.height, 0);
        if let Some(ground) = drawing.ground {
            self.cast(drawing, ground);
        }
    }

    /// Finds the shadows on the ground.
    fn cast(&mut self, drawing: &Drawing<'_>, ground: usize) {
        let lens = drawing.lens;
        let plane = &drawing.geoms[ground].frame;
        let height = (plane.position - drawing.view.origin).dot(plane.axes[2]);
        for (index, geom) in drawing.geoms.iter().enumerate() {
            if index == ground || !geom.casts_shadow {
                continue;
            }
            let whole = drawing.prepared[index].corners;
            for (bit, caster) in drawing.casters.iter().enumerate() {
                let rect = match &whole {
                    Some(corners) => caster.rect(lens, &drawing.view, plane, corners),
                    None => drawing.view.rect(lens, &[drawing.view.origin]),
                };
                for row in rect.rows[0]..rect.rows[1] {
                    for column in rect.columns[0]..rect.columns[1] {
                        let pixel = row * self.width + column;
                        let shown = &self.scene.pixels[pixel].geom;
                        if self.shadows[pixel] >> bit & 1 == 1 || !shown.contains(&(ground as u16))
                        {
                            continue;
                        }
                        let (x, y) = (lens.middle_columns[column], lens.middle_rows[row]);
                        let ray = drawing.view.ray(x, y);
                        let point = drawing.view.origin + ray * (height / ray.dot(plane.axes[2]));
                        let path = caster.path(point);
                        if path.is_some_and(|path| path.meets(geom, &drawing.assets.meshes)) {
                            self.shadows[pixel] |= 1 << bit;
                        }
                    }
                }
            }
        }
    }

    /// Computes the colour and the class of every pixel.
    fn shade(&mut self, drawing: &Drawing<'_>, far: f32) {
        self.lights
            .resize_with(drawing.geoms.len(), CornerLight::default);
        self.grids.clear();
        for (geom, light) in drawing.geoms.iter().zip(&mut self.lights) {
            let grid = match geom.shape {
                Shape::Plane { half, spacing } => Some(Grid::new(half, spacing, far)),
                _ => None,
            };
            light.start(grid.map_or(CORNERS, |grid| grid.corners()), drawing.lights);
            self.grids.push(grid);
        }
        self.colours.clear();
        for pixel in 0..self.width * self.height {
            let samples = self.scene.pixels[pixel].geom;
            let mut sum = [0.0; 3];
            let mut votes = [0; 3];
            let mut last = None;
            let whole = samples.iter().all(|&geom| geom == samples[0]);
            for (k, geom) in samples.into_iter().enumerate() {
                let mirrored = match &drawing.mirror {
                    Some(mirror) if mirror.id == geom => self.mirrored.pixels[pixel].geom[k],
                    _ => NOTHING,
                };
                let colour = match last {
                    Some((same, colour)) if same == (geom, mirrored) => colour,
                    _ => self.sample(drawing, pixel, k, mirrored),
                };
                last =
                    Some(((geom, mirrored), colour)).filter(|_| whole || !drawing.by_sample(geom));
                sum = add(sum, colour);
                let class = drawing.geoms.get(usize::from(geom));
                votes[class.map_or(Class::Background, |geom| geom.class) as usize] += 1;
            }
            self.colours
                .push(sum.map(|value| value * (1.0 / SAMPLES as f32)));
            self.classes[pixel] = majority(votes);
        }
    }

    /// The colour of one sample, with `mirrored` reflected in it.
    fn sample(
        &mut self,
        drawing: &Drawing<'_>,
        pixel: usize,
        sample: usize,
        mirrored: u16,
    ) -> [f32; 3] {
        let geom = self.scene.pixels[pixel].geom[sample];
        if geom == NOTHING {
            return self.sky.pixels[pixel];
        }
        let index = usize::from(geom);
        let own = self.facet(drawing, pixel, sample).unwrap_or_else(|| {
            let at = drawing.place(&self.scene, &drawing.prepared[index].view, pixel, geom);
            match drawing.geoms[index].shape {
                Shape::Plane { .. } => self.floor(drawing, pixel, index, at),
                _ => drawing.body(index, at),
            }
        });
        match &drawing.mirror {
            Some(mirror) if mirrored != NOTHING => {
                let index = usize::from(mirrored);
                let local = &drawing.prepared[index].mirrored;
                let at = drawing.place(&self.mirrored, local, pixel, mirrored);
                let view = (&drawing.mirrored_view, local);
                saturate(add(
                    own,
                    drawing.unshadowed(index, view, at, mirror.reflectance),
                ))
            }
            _ => own,
        }
    }

    /// The colour of an opaque plane.
    fn floor(
        &mut self,
        drawing: &Drawing<'_>,
        pixel: usize,
        index: usize,
        at: [f32; 2],
    ) -> [f32; 3] {
        let view = &drawing.prepared[index].view;
        let geom = &drawing.geoms[index];
        let Some(visible) = Visible::new(geom, drawing.assets, view, at, drawing.near) else {
            return [0.0; 3];
        };
        let lighting = drawing.lighting(index);
        let place = [visible.position.x, visible.position.y];
        let Some(grid) = &self.grids[index] else {
            return [0.0; 3];
        };
        let corners = &mut self.lights[index];
        let blend = grid.blend(place, &lighting, corners);
        let mut light = corners.value(&blend, 0);
        for (bit, caster) in drawing.casters.iter().enumerate() {
            let dark = if drawing.ground == Some(index) {
                self.shadows[pixel] >> bit & 1 == 1
            } else {
                let point = geom.frame.position + geom.frame.to_world(visible.position);
                drawing.is_dark(caster, index, point)
            };
            if !dark {
                light = add(light, corners.value(&blend, 1 + bit));
            }
        }
        let texture = visible.texture(geom, drawing.assets, view, at, drawing.lens.pitch);
        saturate(multiply(light, texture))
    }

    /// The colour that a facet of a curved body gives to a sample.
    fn facet(&mut self, drawing: &Drawing<'_>, pixel: usize, sample: usize) -> Option<[f32; 3]> {
        let id = self.scene.pixels[pixel].geom[sample];
        let index = usize::from(id);
        let (geom, view) = (&drawing.geoms[index], &drawing.prepared[index].view);
        if !drawing.by_sample(id) {
            return None;
        }
        let (middle, whole) = drawing.middle(&self.scene, pixel, id);
        let at = if whole {
            middle
        } else {
            drawing.sample(pixel, sample)
        };
        let visible = Visible::new(geom, drawing.assets, view, at, drawing.near)?;
        let facet = Facet::at(&geom.shape, visible.position)?;
        let ray = view.ray(middle[0], middle[1]);
        let (shares, distance) = facet.meet(view.origin, ray)?;
        let corners = &mut self.lights[index];
        let blend = facet.blend(shares, &drawing.lighting(index), corners);
        let place = view.origin + ray * distance;
        let point = geom.frame.position + geom.frame.to_world(place);
        let mut colour = saturate(corners.value(&blend, 0));
        for (bit, caster) in drawing.casters.iter().enumerate() {
            let light = saturate(corners.value(&blend, 1 + bit));
            if light != [0.0; 3] && !drawing.is_dark(caster, index, point) {
                colour = add(colour, light);
            }
        }
        let texture = visible.texture(geom, drawing.assets, view, at, drawing.lens.pitch);
        Some(saturate(multiply(colour, texture)))
    }

    /// Lays a transparent geom over what is there.
    fn blend(&mut self, drawing: &Drawing<'_>, index: usize) {
        let prepared = &drawing.prepared[index];
        let target = drawing.target(index, &drawing.view, &prepared.view);
        let mut front = Layer::default();
        front.clear(self.width * self.height);
        front.draw(drawing.lens, &target, drawing.near);
        for (pixel, samples) in front.pixels.iter().enumerate() {
            let behind = &self.scene.pixels[pixel].depth;
            let covered = (0..SAMPLES)
                .filter(|&k| samples.depth[k] < behind[k])
                .count();
            if covered == 0 {
                continue;
            }
            let at = drawing.place(&front, &prepared.view, pixel, target.id);
            let view = (&drawing.view, &prepared.view);
            let colour = drawing.unshadowed(index, view, at, 1.0);
            let share = prepared.alpha * covered as f32 / SAMPLES as f32;
            let there = self.colours[pixel];
            self.colours[pixel] =
                std::array::from_fn(|c| there[c] + share * (colour[c] - there[c]));
            // It is drawn twice.
            if share > 1.0 - std::f32::consts::FRAC_1_SQRT_2 {
                self.classes[pixel] = drawing.geoms[index].class;
            }
        }
    }
}

/// The class with most votes; of equals, the one that stands out more.
fn majority(votes: [u32; 3]) -> Class {
    let classes = [Class::Background, Class::Floor, Class::Body];
    let best = classes
        .into_iter()
        .max_by_key(|&class| votes[class as usize]);
    best.unwrap_or(Class::Background)
}
