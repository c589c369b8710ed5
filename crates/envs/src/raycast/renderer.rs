//! The order of drawing.

use std::sync::Arc;

use super::floor::{FloorLight, Lighting};
use super::layer::{Layer, Mirror, NOTHING, Target};
use super::light::{Point, add, multiply, saturate, unlit};
use super::prepared::{Prepared, transparent};
use super::scene::{Assets, Class, Geom, Light, Scene, Shape};
use super::shadow::Caster;
use super::sky::Sky;
use super::surface::Visible;
use super::view::{Lens, SAMPLES, View};

/// Lights beyond these stay dark, as in OpenGL.
const LIGHTS: usize = 8;

/// Draws scenes of one model, all of the same size.
///
/// Nothing of a scene is left for the next one but memory and the sky, which is computed again when the observer
/// turns.
#[derive(Debug)]
pub struct Renderer {
    assets: Arc<Assets>,
    width: usize,
    height: usize,
    lens: Lens,
    sky: Sky,
    scene: Layer,
    mirrored: Layer,
    /// Of the ground in the middle of each pixel, `[height, width]`, one bit per light that throws shadows.
    shadows: Vec<u8>,
    /// Of the geom with the same index.
    floors: Vec<FloorLight>,
    colours: Vec<[f32; 3]>,
    classes: Vec<Class>,
}

/// What is fixed while one scene is drawn.
struct Drawing<'a> {
    assets: &'a Assets,
    geoms: &'a [Geom],
    lights: &'a [Light],
    /// Of the lights that throw shadows, in their order.
    casters: Vec<Caster>,
    prepared: Vec<Prepared>,
    lens: &'a Lens,
    view: View,
    near: f32,
    mirror: Option<Mirror>,
    mirrored_view: View,
    /// The plane whose shadows are computed before its pixels.
    ground: Option<usize>,
}

impl Renderer {
    /// A renderer of pictures with `height` rows and `width` columns.
    pub fn new(assets: Arc<Assets>, height: usize, width: usize) -> Self {
        Self {
            assets,
            width,
            height,
            lens: Lens::default(),
            sky: Sky::default(),
            scene: Layer::default(),
            mirrored: Layer::default(),
            shadows: Vec::new(),
            floors: Vec::new(),
            colours: Vec::new(),
            classes: vec![Class::Background; width * height],
        }
    }

    /// Draws the scene: `[height, width, 3]` red, green and blue, the upper left pixel first.
    pub fn render(&mut self, scene: &Scene) -> Vec<u8> {
        let mut picture = vec![0; self.width * self.height * 3];
        self.render_into(scene, &mut picture);
        picture
    }

    /// [`render`](Self::render) into memory that is there.
    ///
    /// # Panics
    /// If that is not `height * width * 3` bytes.
    pub fn render_into(&mut self, scene: &Scene, picture: &mut [u8]) {
        assert_eq!(
            picture.len(),
            self.width * self.height * 3,
            "bytes of the picture"
        );
        let lens = Lens::new(&scene.camera, self.width, self.height);
        if lens != self.lens {
            self.lens = lens;
        }
        let assets = Arc::clone(&self.assets);
        let lens = std::mem::take(&mut self.lens);
        let drawing = Drawing::new(scene, &assets, &lens);
        self.sky.look(&assets, &drawing.view, &lens);
        self.see(&drawing);
        self.shade(&drawing, scene.camera.far);
        for index in drawing.blending_order(scene) {
            self.blend(&drawing, index);
        }
        self.lens = lens;
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
        self.floors
            .resize_with(drawing.geoms.len(), FloorLight::default);
        for (index, floor) in self.floors.iter_mut().enumerate() {
            if matches!(drawing.geoms[index].shape, Shape::Plane { .. }) {
                floor.start(&drawing.lighting(index), far);
            }
        }
        self.colours.clear();
        for pixel in 0..self.width * self.height {
            let samples = self.scene.pixels[pixel].geom;
            let mut sum = [0.0; 3];
            let mut votes = [0; 3];
            let mut last = None;
            for k in 0..SAMPLES {
                let geom = samples[k];
                let mirrored = match &drawing.mirror {
                    Some(mirror) if mirror.id == geom => self.mirrored.pixels[pixel].geom[k],
                    _ => NOTHING,
                };
                let colour = match last {
                    Some((same, colour)) if same == (geom, mirrored) => colour,
                    _ => self.sample(drawing, pixel, geom, mirrored),
                };
                last = Some(((geom, mirrored), colour));
                sum = add(sum, colour);
                let class = drawing.geoms.get(usize::from(geom));
                votes[class.map_or(Class::Background, |geom| geom.class) as usize] += 1;
            }
            self.colours
                .push(sum.map(|value| value * (1.0 / SAMPLES as f32)));
            self.classes[pixel] = majority(votes);
        }
    }

    /// The colour of one sample: that of `geom`, with `mirrored` reflected in it.
    fn sample(
        &mut self,
        drawing: &Drawing<'_>,
        pixel: usize,
        geom: u16,
        mirrored: u16,
    ) -> [f32; 3] {
        if geom == NOTHING {
            return self.sky.pixels[pixel];
        }
        let index = usize::from(geom);
        let at = drawing.place(&self.scene, &drawing.prepared[index].view, pixel, geom);
        let own = match drawing.geoms[index].shape {
            Shape::Plane { .. } => self.floor(drawing, pixel, index, at),
            _ => drawing.body(index, at),
        };
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
        let floor = &mut self.floors[index];
        let blend = floor.blend(place, &lighting);
        let mut light = floor.value(&blend, 0);
        for (bit, caster) in drawing.casters.iter().enumerate() {
            let dark = if drawing.ground == Some(index) {
                self.shadows[pixel] >> bit & 1 == 1
            } else {
                let point = geom.frame.position + geom.frame.to_world(visible.position);
                drawing.is_dark(caster, index, point)
            };
            if !dark {
                light = add(light, floor.value(&blend, 1 + bit));
            }
        }
        let texture = visible.texture(geom, drawing.assets, view, at, drawing.lens.pitch);
        saturate(multiply(light, texture))
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

impl<'a> Drawing<'a> {
    fn new(scene: &'a Scene, assets: &'a Assets, lens: &'a Lens) -> Self {
        let view = View::new(&scene.camera);
        let mut prepared: Vec<_> = scene
            .geoms
            .iter()
            .map(|geom| Prepared::new(geom, &assets.meshes, &view))
            .collect();
        let lights = &scene.lights[..scene.lights.len().min(LIGHTS)];
        let mirror = find_mirror(&scene.geoms, &prepared);
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

    fn target(&self, index: usize, view: &View, local: &'a View) -> Target<'a>
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

    fn lighting(&self, index: usize) -> Lighting<'_> {
        Lighting {
            geom: &self.geoms[index],
            lights: self.lights,
            eye: self.view.origin,
        }
    }

    /// Transparent geoms, once from the front and once from the back.
    fn blending_order(&self, scene: &Scene) -> Vec<usize> {
        let mut order = transparent(scene, &self.prepared);
        order.extend(order.clone().iter().rev());
        order
    }

    /// The tangents at which a geom is shaded in a pixel: the middle, if it is there, else the middle of the
    /// samples that show it.
    fn place(&self, layer: &Layer, local: &View, pixel: usize, geom: u16) -> [f32; 2] {
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

    /// The colour of an opaque body.
    fn body(&self, index: usize, at: [f32; 2]) -> [f32; 3] {
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
    fn unshadowed(
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
    fn is_dark(&self, caster: &Caster, index: usize, point: super::vec3::Vec3) -> bool {
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
fn find_mirror(geoms: &[Geom], prepared: &[Prepared]) -> Option<Mirror> {
    let (index, geom) = geoms.iter().enumerate().find(|(index, geom)| {
        matches!(geom.shape, Shape::Plane { .. } | Shape::Box { .. })
            && geom.material.reflectance > 0.0
            && !prepared[*index].transparent
    })?;
    let mut frame = geom.frame;
    let mut height = prepared[index].view.origin.z;
    if let Shape::Box { half } = geom.shape {
        frame.position = frame.position + frame.axes[2] * half.z;
        height -= half.z;
    }
    (height >= 0.0).then_some(Mirror {
        id: index as u16,
        reflectance: geom.material.reflectance,
        frame,
    })
}
