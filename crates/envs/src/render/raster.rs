//! Convex polygons into a depth-buffered picture of 2 x 2 samples per pixel.

use super::camera::{Camera, ViewPoint};
use super::colour::{Rgb, to_bytes};

/// Samples per pixel in each direction.
pub(super) const SAMPLES: usize = 2;
/// Nothing nearer than this is drawn.
const NEAR_M: f32 = 0.3;
/// A quadrilateral clipped by one plane has at most five corners; crowns of trees start with six.
const MOST_CORNERS: usize = 8;
/// Factor by which details win against the face that they lie on.
const DETAIL_BIAS: f32 = 1.01;

/// What a sample shows, where something stands on the ground.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sample {
    pub(super) colour: [u8; 3],
    pub(super) class: u8,
}

/// No object here: the ground or the sky shows.
pub(super) const EMPTY: Sample = Sample {
    colour: [0; 3],
    class: u8::MAX,
};

#[derive(Debug, Clone)]
pub(super) struct Raster {
    size: usize,
    samples: Vec<Sample>,
    /// One over the distance; 0 is infinitely far.
    nearness: Vec<f32>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Corner {
    x: f32,
    y: f32,
    nearness: f32,
}

/// How a polygon covers others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Layer {
    Solid,
    /// Lies on a solid face, such as a lamp or a window.
    Detail,
}

impl Raster {
    pub(super) fn new(image_size: usize) -> Self {
        let size = image_size * SAMPLES;
        Self {
            size,
            samples: vec![EMPTY; size * size],
            nearness: vec![0.0; size * size],
        }
    }

    pub(super) fn clear(&mut self) {
        self.samples.fill(EMPTY);
        self.nearness.fill(0.0);
    }

    /// The samples of pixel `(x, y)`, row by row.
    pub(super) fn pixel(&self, x: usize, y: usize) -> [Sample; SAMPLES * SAMPLES] {
        let first = y * SAMPLES * self.size + x * SAMPLES;
        let second = first + self.size;
        [
            self.samples[first],
            self.samples[first + 1],
            self.samples[second],
            self.samples[second + 1],
        ]
    }

    /// Whether objects hide everything behind pixel `(x, y)`.
    pub(super) fn is_covered(&self, x: usize, y: usize) -> bool {
        self.pixel(x, y).iter().all(|&sample| sample != EMPTY)
    }

    /// Fills a convex polygon. Corners run counter-clockwise as seen from outside: the back is not drawn.
    pub(super) fn fill(
        &mut self,
        camera: &Camera,
        polygon: &[ViewPoint],
        colour: Rgb,
        class: u8,
        layer: Layer,
    ) {
        let mut buffer = [Corner::default(); MOST_CORNERS];
        let count = clip_and_project(camera, polygon, &mut buffer);
        let corners = &buffer[..count];
        if count < 3 || is_back(corners) {
            return;
        }
        let bias = match layer {
            Layer::Solid => 1.0,
            Layer::Detail => DETAIL_BIAS,
        };
        let sample = Sample {
            colour: to_bytes(colour),
            class,
        };
        let (mut top, mut bottom) = (f32::INFINITY, f32::NEG_INFINITY);
        for corner in corners {
            top = top.min(corner.y);
            bottom = bottom.max(corner.y);
        }
        let first_row = first_cell(top);
        let end_row = first_cell(bottom).min(self.size);
        for row in first_row..end_row {
            self.fill_row(corners, row, bias, sample);
        }
    }

    fn fill_row(&mut self, corners: &[Corner], row: usize, bias: f32, sample: Sample) {
        let y = row as f32 + 0.5;
        let (mut left, mut right) = (f32::INFINITY, f32::NEG_INFINITY);
        let (mut near_left, mut near_right) = (0.0, 0.0);
        let mut previous = corners[corners.len() - 1];
        for &corner in corners {
            if (previous.y <= y) != (corner.y <= y) {
                let part = (y - previous.y) / (corner.y - previous.y);
                let x = previous.x + part * (corner.x - previous.x);
                let nearness = previous.nearness + part * (corner.nearness - previous.nearness);
                if x < left {
                    (left, near_left) = (x, nearness);
                }
                if x > right {
                    (right, near_right) = (x, nearness);
                }
            }
            previous = corner;
        }
        let first = first_cell(left);
        let end = first_cell(right).min(self.size);
        if first >= end {
            return;
        }
        let slope = (near_right - near_left) / (right - left).max(1e-6);
        let mut nearness = near_left + (first as f32 + 0.5 - left) * slope;
        let cells = row * self.size + first..row * self.size + end;
        let depths = &mut self.nearness[cells.clone()];
        for (stored, place) in self.samples[cells].iter_mut().zip(depths) {
            if nearness * bias > *place {
                *place = nearness;
                *stored = sample;
            }
            nearness += slope;
        }
    }
}

/// The first cell whose sample, in its middle, lies at or beyond `edge`. Casts saturate at 0.
fn first_cell(edge: f32) -> usize {
    (edge + 0.5) as usize
}

fn clip_and_project(
    camera: &Camera,
    polygon: &[ViewPoint],
    out: &mut [Corner; MOST_CORNERS],
) -> usize {
    let mut count = 0;
    let mut push = |point: ViewPoint| {
        let [x, y] = camera.project(point);
        out[count] = Corner {
            x: x * SAMPLES as f32,
            y: y * SAMPLES as f32,
            nearness: 1.0 / point[2],
        };
        count += 1;
    };
    let mut previous = polygon[polygon.len() - 1];
    for &point in polygon {
        if (previous[2] >= NEAR_M) != (point[2] >= NEAR_M) {
            let part = (NEAR_M - previous[2]) / (point[2] - previous[2]);
            push(std::array::from_fn(|i| {
                previous[i] + part * (point[i] - previous[i])
            }));
        }
        if point[2] >= NEAR_M {
            push(point);
        }
        previous = point;
    }
    count
}

/// Rows grow downwards, so a front has negative area.
fn is_back(corners: &[Corner]) -> bool {
    let mut area = 0.0;
    let mut previous = corners[corners.len() - 1];
    for &corner in corners {
        area += previous.x * corner.y - corner.x * previous.y;
        previous = corner;
    }
    area >= 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Vec2;

    const RED: Rgb = [1.0, 0.0, 0.0];
    const BLUE: Rgb = [0.0, 0.0, 1.0];

    fn square(half: f32, ahead: f32) -> [ViewPoint; 4] {
        [
            [-half, -half, ahead],
            [half, -half, ahead],
            [half, half, ahead],
            [-half, half, ahead],
        ]
    }

    fn covered(raster: &Raster) -> usize {
        raster
            .samples
            .iter()
            .filter(|&&sample| sample != EMPTY)
            .count()
    }

    #[test]
    fn a_square_covers_its_projected_area() {
        let camera = Camera::on_ego(Vec2::default(), 0.0, 64);
        let mut raster = Raster::new(64);
        raster.fill(&camera, &square(1.0, 10.0), RED, 2, Layer::Solid);
        let side = 2.0 * camera.focal / 10.0 * SAMPLES as f64;
        let share = covered(&raster) as f64 / (side * side);
        assert!((0.9..1.1).contains(&share), "{share}");
    }

    #[test]
    fn the_nearer_one_wins_in_either_order() {
        let camera = Camera::on_ego(Vec2::default(), 0.0, 64);
        let mut forth = Raster::new(64);
        forth.fill(&camera, &square(1.0, 10.0), RED, 2, Layer::Solid);
        forth.fill(&camera, &square(4.0, 20.0), BLUE, 0, Layer::Solid);
        let mut back = Raster::new(64);
        back.fill(&camera, &square(4.0, 20.0), BLUE, 0, Layer::Solid);
        back.fill(&camera, &square(1.0, 10.0), RED, 2, Layer::Solid);
        assert_eq!(forth.samples, back.samples);
        assert_eq!(forth.pixel(32, 32)[0].colour, [255, 0, 0]);
    }

    #[test]
    fn backs_and_what_is_behind_the_camera_are_not_drawn() {
        let camera = Camera::on_ego(Vec2::default(), 0.0, 64);
        let mut raster = Raster::new(64);
        let mut back = square(1.0, 10.0);
        back.reverse();
        raster.fill(&camera, &back, RED, 2, Layer::Solid);
        raster.fill(&camera, &square(1.0, -10.0), RED, 2, Layer::Solid);
        assert_eq!(covered(&raster), 0);
    }
}
