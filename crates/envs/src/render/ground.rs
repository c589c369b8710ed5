//! The ground below the horizon: one ray per pixel, with every edge and line averaged over the pixel's
//! footprint, so that far lines fade instead of flickering.

use super::camera::{Camera, EYE_HEIGHT_M};
use super::colour::{Rgb, mix, noise, scale};
use super::light::{Facing, Lighting};
use super::raster::Raster;
use crate::environment::class;
use crate::highway::{BARRIER_D, LANE_WIDTH, LANES, LANES_HALF_WIDTH, Road};

/// Wider than real paint (0.15 m), so that it shows at 64 pixels.
const LINE_M: f64 = 0.26;
const DASH_M: f64 = 4.0;
const DASH_EVERY_M: f64 = 10.0;
/// Beyond this the ground is drawn as haze: less than a sample of a row.
const FARTHEST_M: f64 = 700.0;

const ASPHALT: Rgb = [0.33, 0.33, 0.35];
const SHOULDER: Rgb = [0.42, 0.40, 0.38];
const GRASS: Rgb = [0.31, 0.47, 0.19];
const WHITE: Rgb = [0.95, 0.95, 0.93];
const YELLOW: Rgb = [0.98, 0.76, 0.16];

/// A stretch of ground under one pixel, in road coordinates.
#[derive(Debug, Clone, Copy)]
struct Footprint {
    s: f64,
    d: f64,
    /// Extent along and across the road.
    along: f64,
    across: f64,
}

/// Draws the ground of one picture.
pub(super) struct Ground<'a> {
    pub(super) camera: &'a Camera,
    pub(super) light: &'a Lighting,
    pub(super) road: &'a Road,
    pub(super) ego_s: f64,
    /// What stands on the ground: pixels that it hides are left out.
    pub(super) covered: &'a Raster,
}

/// The colours of one row of pixels, and how many of each pixel's rays hit the road.
struct Row {
    colours: Vec<Rgb>,
    on_road: Vec<usize>,
}

impl Ground<'_> {
    /// Fills the rows below the horizon of `image` and `classes`, row-major pictures of `size` x `size`.
    pub(super) fn draw(&self, image: &mut [Rgb], classes: &mut [u8], size: usize) {
        let mut guess = self.ego_s;
        let mut row = Row {
            colours: vec![[0.0; 3]; size],
            on_road: vec![0; size],
        };
        // From near to far, so that the place found for one row is a good guess for the next.
        for y in (size / 2..size).rev() {
            let below = (y as f64 + 0.5 - self.camera.centre).max(0.0);
            let rays = rays_per_pixel(below);
            row.colours.fill([0.0; 3]);
            row.on_road.fill(0);
            for ray in (0..rays).rev() {
                let offset = below + (ray as f64 + 0.5) / rays as f64 - 0.5;
                if offset > 0.0 {
                    guess = self.add_rays(&mut row, y, offset, 1.0 / rays as f64, guess);
                }
            }
            let pixels = y * size..(y + 1) * size;
            image[pixels.clone()].copy_from_slice(&row.colours);
            for (class, &on_road) in classes[pixels].iter_mut().zip(&row.on_road) {
                *class = if 2 * on_road >= rays {
                    class::ROAD
                } else {
                    class::BACKGROUND
                };
            }
        }
    }

    /// Adds one ray per pixel of row `y`, `offset` pixels below the horizon and `share` pixels high. Takes
    /// a guess of the first ray's place on the road and returns that place.
    fn add_rays(&self, row: &mut Row, y: usize, offset: f64, share: f64, guess: f64) -> f64 {
        let camera = self.camera;
        let ahead = EYE_HEIGHT_M * camera.focal / offset;
        let haze = self.light.horizon;
        if ahead > FARTHEST_M {
            for colour in &mut row.colours {
                *colour = add(*colour, haze, share as f32);
            }
            return guess;
        }
        let clearness = self.light.clearness(ahead as f32);
        let depth = ahead / offset * share;
        let step = camera.right() * (ahead / camera.focal);
        let (mut s, mut advance, mut first_s) = (guess, 0.0, guess);
        for x in 0..row.colours.len() {
            if x > 0 && self.covered.is_covered(x, y) {
                s += advance;
                continue;
            }
            let column = x as f64 + 0.5 - camera.centre;
            let place = camera.eye + camera.forward * ahead + step * column;
            let (at, node) = self.road.project_with_node(place, s + advance);
            if x == 0 {
                first_s = at.s;
            } else {
                // Pixels of a row are evenly spaced: the next place is as far again.
                advance += self.road.ahead(s + advance, at.s);
            }
            s = at.s;
            // One pixel down moves the place towards the eye.
            let down = (camera.forward + camera.right() * (column / camera.focal)) * depth;
            let normal = node.tangent.left();
            let footprint = Footprint {
                s: at.s,
                d: at.d,
                along: down.dot(node.tangent).abs() + step.dot(node.tangent).abs(),
                across: down.dot(normal).abs() + step.dot(normal).abs(),
            };
            let point = [(column * ahead / camera.focal) as f32, 0.0, ahead as f32];
            let lit = self
                .light
                .lit(albedo(self.light, &footprint), point, Facing::Ground);
            row.colours[x] = add(row.colours[x], mix(haze, lit, clearness), share as f32);
            row.on_road[x] += usize::from(at.d.abs() <= BARRIER_D);
        }
        first_s
    }
}

fn add(sum: Rgb, colour: Rgb, share: f32) -> Rgb {
    std::array::from_fn(|i| sum[i] + colour[i] * share)
}

/// Rows near the horizon span hundreds of metres: their rays are spread over the pixel's height.
fn rays_per_pixel(below_horizon: f64) -> usize {
    match below_horizon {
        offset if offset < 2.0 => 4,
        offset if offset < 5.0 => 2,
        _ => 1,
    }
}

fn albedo(light: &Lighting, at: &Footprint) -> Rgb {
    let road = coverage(at.d, at.across, -LANES_HALF_WIDTH, LANES_HALF_WIDTH);
    let paved = coverage(at.d, at.across, -BARRIER_D, BARRIER_D);
    let mut colour = SHOULDER;
    if paved < 1.0 {
        colour = mix(grass(at), colour, paved);
    }
    if road > 0.0 {
        colour = mix(colour, asphalt(at), road);
        colour = paint(colour, at);
    }
    // Lamps are folded into the albedo: at night a pool of lamplight is a brighter ground.
    scale(colour, 1.0 + light.lamps(at.s) * paved)
}

fn asphalt(at: &Footprint) -> Rgb {
    const PATCH_M: f64 = 7.0;
    let visible = resolved(at.along, PATCH_M);
    if visible == 0.0 {
        return ASPHALT;
    }
    let lane = ((at.d + LANES_HALF_WIDTH) / LANE_WIDTH) as i64;
    let patch = noise((at.s / PATCH_M) as i64 * 8 + lane, 1) - 0.5;
    scale(ASPHALT, 1.0 + 0.16 * patch * visible)
}

fn grass(at: &Footprint) -> Rgb {
    const PATCH_M: f64 = 5.0;
    let visible = resolved(at.along.max(at.across), PATCH_M);
    if visible == 0.0 {
        return GRASS;
    }
    // Never in the same row as the other side's grass, which truncation would fold onto it.
    let row = (at.d / PATCH_M) as i64 * 2 + i64::from(at.d > 0.0);
    let patch = noise((at.s / PATCH_M) as i64 * 256 + row, 2) - 0.5;
    scale(GRASS, 1.0 + 0.35 * patch * visible)
}

/// How much of a pattern of `period` metres survives a footprint of `extent`.
fn resolved(extent: f64, period: f64) -> f32 {
    (1.0 - extent / period).max(0.0) as f32
}

fn paint(mut colour: Rgb, at: &Footprint) -> Rgb {
    let line = |d: f64| coverage(at.d, at.across, d - LINE_M / 2.0, d + LINE_M / 2.0);
    let edge = LANES_HALF_WIDTH - 0.15;
    colour = mix(colour, WHITE, line(-edge));
    colour = mix(colour, YELLOW, line(edge));
    for lane in 1..LANES {
        let covered = line(lane as f64 * LANE_WIDTH - LANES_HALF_WIDTH);
        if covered > 0.0 {
            colour = mix(colour, WHITE, covered * dashes(at.s, at.along));
        }
    }
    colour
}

/// Share of `[centre - extent / 2, centre + extent / 2]` that lies in `[from, to]`.
fn coverage(centre: f64, extent: f64, from: f64, to: f64) -> f32 {
    let (low, high) = (centre - extent / 2.0, centre + extent / 2.0);
    let covered = high.min(to) - low.max(from);
    // Most footprints miss most lines: this spares their divisions.
    if covered <= 0.0 {
        return 0.0;
    }
    (covered / extent) as f32
}

const PERIODS_BEFORE: f64 = 1e5;

/// Share of the stretch around `s` that dashes cover.
fn dashes(s: f64, extent: f64) -> f32 {
    let painted_until = |s: f64| {
        // Truncation is `floor` here, as no footprint reaches this far before the table's start.
        let whole = (s / DASH_EVERY_M + PERIODS_BEFORE) as i64 as f64 - PERIODS_BEFORE;
        whole * DASH_M + (s - whole * DASH_EVERY_M).min(DASH_M)
    };
    ((painted_until(s + extent / 2.0) - painted_until(s - extent / 2.0)) / extent) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coverage_is_a_share_of_the_footprint() {
        assert_eq!(coverage(0.0, 2.0, -5.0, 5.0), 1.0);
        assert_eq!(coverage(0.0, 2.0, 0.5, 5.0), 0.25);
        assert_eq!(coverage(0.0, 2.0, 3.0, 5.0), 0.0);
    }

    #[test]
    fn far_dashes_fade_to_their_mean() {
        let share = (DASH_M / DASH_EVERY_M) as f32;
        for i in 0..20 {
            let far = dashes(f64::from(i) * 1.3, 30.0 * DASH_EVERY_M);
            assert!((far - share).abs() < 1e-3);
        }
        assert_eq!(dashes(2.0, 0.1), 1.0);
        assert_eq!(dashes(7.0, 0.1), 0.0);
    }
}
