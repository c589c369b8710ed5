//! What stands beside the lanes: barriers, street lamps and trees. All of it is fixed to the road, so
//! that it shows how fast the ego goes.

use super::camera::{Camera, ViewPoint};
use super::colour::{Rgb, mix, noise, scale};
use super::light::{Facing, LAMP_EVERY_M, Light, Lighting};
use super::raster::{Layer, Raster};
use crate::environment::class;
use crate::highway::{BARRIER_D, Frenet, Road};

const BARRIER_HEIGHT_M: f64 = 0.85;
const PANEL_M: f64 = 4.0;
const TREE_EVERY_M: f64 = 11.0;
/// How far along the road things are drawn, before and behind the ego.
const AHEAD_M: f64 = 230.0;
const BEHIND_M: f64 = 60.0;

const BARRIER: Rgb = [0.68, 0.68, 0.66];
const BARRIER_MARK: Rgb = [0.80, 0.30, 0.24];
const POLE: Rgb = [0.45, 0.46, 0.48];
const LAMP: Rgb = [1.0, 0.93, 0.70];
const BARK: Rgb = [0.28, 0.19, 0.12];
const LEAVES: [Rgb; 3] = [[0.10, 0.34, 0.12], [0.20, 0.42, 0.12], [0.07, 0.27, 0.16]];

struct Brush<'a> {
    camera: &'a Camera,
    light: &'a Lighting,
    road: &'a Road,
    raster: &'a mut Raster,
}

/// Draws everything beside the lanes around `ego_s`.
pub(super) fn draw(
    camera: &Camera,
    light: &Lighting,
    road: &Road,
    ego_s: f64,
    raster: &mut Raster,
) {
    let mut brush = Brush {
        camera,
        light,
        road,
        raster,
    };
    for index in cells(ego_s, PANEL_M) {
        for side in [1.0, -1.0] {
            brush.barrier(index, side);
        }
    }
    for index in cells(ego_s, TREE_EVERY_M) {
        for side in [1.0, -1.0] {
            brush.tree(index, side);
        }
    }
    for index in cells(ego_s, LAMP_EVERY_M) {
        brush.lamp(index);
    }
}

/// Indices of the cells of `length` around `ego_s`. Cells are fixed to the road.
fn cells(ego_s: f64, length: f64) -> std::ops::Range<i64> {
    let at = |s: f64| (s / length).floor() as i64;
    at(ego_s - BEHIND_M)..at(ego_s + AHEAD_M)
}

impl Brush<'_> {
    fn view(&self, s: f64, d: f64, height: f64) -> ViewPoint {
        self.camera
            .view(self.road.to_world(Frenet { s, d }), height)
    }

    /// Whether a thing that is `room` wide at `point` may be in the picture.
    fn may_be_seen(&self, [right, _, ahead]: ViewPoint, room: f32) -> bool {
        ahead > -room && right.abs() < 0.6 * ahead + 2.0 * room
    }

    fn barrier(&mut self, index: i64, side: f64) {
        let (from, to) = (index as f64 * PANEL_M, (index + 1) as f64 * PANEL_M);
        let d = side * BARRIER_D;
        let foot = [self.view(from, d, 0.0), self.view(to, d, 0.0)];
        if !self.may_be_seen(foot[0], PANEL_M as f32) {
            return;
        }
        let head = [
            self.view(from, d, BARRIER_HEIGHT_M),
            self.view(to, d, BARRIER_HEIGHT_M),
        ];
        let mut panel = [foot[0], foot[1], head[1], head[0]];
        if side < 0.0 {
            panel.reverse();
        }
        let marked = index.rem_euclid(4) == 0;
        let albedo = match (marked, index % 2 == 0) {
            (true, _) => BARRIER_MARK,
            (false, true) => BARRIER,
            (false, false) => scale(BARRIER, 0.86),
        };
        let lit = scale(albedo, 1.0 + self.light.lamps(from.max(0.0)));
        let colour = self.light.shade(lit, foot[0], Facing::Ground);
        self.raster
            .fill(self.camera, &panel, colour, class::ROAD, Layer::Solid);
    }

    /// An upright rectangle that faces the camera.
    fn post(&mut self, foot: ViewPoint, half_width: f32, height: f32, colour: Rgb) {
        let [right, up, ahead] = foot;
        let corners = [
            [right - half_width, up, ahead],
            [right + half_width, up, ahead],
            [right + half_width, up + height, ahead],
            [right - half_width, up + height, ahead],
        ];
        self.raster.fill(
            self.camera,
            &corners,
            colour,
            class::BACKGROUND,
            Layer::Solid,
        );
    }

    fn lamp(&mut self, index: i64) {
        let side = if index.rem_euclid(2) == 0 { 1.0 } else { -1.0 };
        let s = index as f64 * LAMP_EVERY_M;
        let foot = self.view(s, side * (BARRIER_D + 0.8), 0.0);
        if !self.may_be_seen(foot, 4.0) {
            return;
        }
        let colour = self.light.shade(POLE, foot, Facing::Side);
        self.post(foot, 0.11, 7.0, colour);
        let mut head = self.view(s, side * (BARRIER_D - 0.8), 6.9);
        head[2] = foot[2].min(head[2]);
        let glow = match self.light.light {
            Light::Day => self.light.shade(POLE, foot, Facing::Side),
            Light::Night => self.light.through_air(LAMP, foot[2] * 0.5),
        };
        self.post(head, 0.75, 0.3, glow);
    }

    fn tree(&mut self, index: i64, side: f64) {
        let place = index * 2 + i64::from(side > 0.0);
        if noise(place, 3) < 0.35 {
            return;
        }
        let s = (index as f64 + f64::from(noise(place, 4))) * TREE_EVERY_M;
        let d = side * (BARRIER_D + 4.0 + 16.0 * f64::from(noise(place, 5)));
        let foot = self.view(s, d, 0.0);
        if !self.may_be_seen(foot, 5.0) {
            return;
        }
        let height = 4.5 + 5.0 * noise(place, 6);
        let leaves = LEAVES[(noise(place, 7) * LEAVES.len() as f32) as usize];
        let bark = self.light.shade(BARK, foot, Facing::Camera);
        self.post(foot, 0.22, height * 0.4, bark);

        let shade = |albedo: Rgb| self.light.shade(albedo, foot, Facing::Camera);
        let (dark, bright) = (shade(leaves), shade(mix(leaves, [0.5, 0.6, 0.2], 0.25)));
        let conifer = noise(place, 8) < 0.45;
        let outline: &[[f32; 2]] = if conifer { &CONIFER } else { &ROUND };
        let reach = height * if conifer { 0.24 } else { 0.32 };
        self.crown(foot, height, reach, outline, dark);
        self.crown(foot, height * 0.97, reach * 0.55, outline, bright);
    }

    /// `outline` is in units of `reach` to the right and of `height` above the foot.
    fn crown(
        &mut self,
        foot: ViewPoint,
        height: f32,
        reach: f32,
        outline: &[[f32; 2]],
        colour: Rgb,
    ) {
        let [right, up, ahead] = foot;
        let mut corners = [[0.0; 3]; 6];
        for (corner, [x, y]) in corners.iter_mut().zip(outline) {
            *corner = [right + x * reach, up + y * height, ahead];
        }
        self.raster.fill(
            self.camera,
            &corners[..outline.len()],
            colour,
            class::BACKGROUND,
            Layer::Detail,
        );
    }
}

const CONIFER: [[f32; 2]; 3] = [[-1.0, 0.2], [1.0, 0.2], [0.0, 1.0]];
const ROUND: [[f32; 2]; 6] = [
    [-0.6, 0.3],
    [0.6, 0.3],
    [1.0, 0.62],
    [0.55, 1.0],
    [-0.55, 1.0],
    [-1.0, 0.62],
];
