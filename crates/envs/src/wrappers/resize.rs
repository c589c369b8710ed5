//! Observations of another size.

use isodream_core::{EnvSpec, ImageShape};

use super::forward;
use crate::resize::area_spans;
use crate::{EnvError, Environment, Transition};

/// Shows images at another size: every pixel is the mean of the area that it covers, so that shrinking does
/// not flicker. Classes of pixels are those at the centres.
pub struct Resize {
    env: Box<dyn Environment>,
    spec: EnvSpec,
    rows: Vec<Vec<(usize, f32)>>,
    columns: Vec<Vec<(usize, f32)>>,
}

impl Resize {
    /// Shows what `env` shows at `height` x `width` (at least one pixel each).
    pub fn new(env: Box<dyn Environment>, height: usize, width: usize) -> Self {
        let mut spec = env.spec().clone();
        let from = spec.image;
        spec.image = ImageShape {
            height: height.max(1),
            width: width.max(1),
            channels: from.channels,
        };
        Self {
            rows: area_spans(from.height, spec.image.height),
            columns: area_spans(from.width, spec.image.width),
            env,
            spec,
        }
    }

    fn resized(&self, mut row: Transition) -> Transition {
        let ImageShape {
            width, channels, ..
        } = self.env.spec().image;
        let mut image = Vec::with_capacity(self.spec.image.bytes());
        for down in &self.rows {
            for along in &self.columns {
                for channel in 0..channels {
                    let mut sum = 0.0;
                    for &(y, height_share) in down {
                        for &(x, width_share) in along {
                            let byte = row.image[(y * width + x) * channels + channel];
                            sum += height_share * width_share * f32::from(byte);
                        }
                    }
                    image.push((sum + 0.5) as u8);
                }
            }
        }
        row.image = image;
        row
    }
}

impl Environment for Resize {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        let row = self.env.reset(seed)?;
        Ok(self.resized(row))
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        let row = self.env.step(action)?;
        Ok(self.resized(row))
    }

    fn segmentation(&self) -> Option<Vec<u8>> {
        let classes = self.env.segmentation()?;
        let (from, to) = (self.env.spec().image, self.spec.image);
        let centre = |index: usize, from: usize, to: usize| (2 * index + 1) * from / (2 * to);
        let pixels = (0..to.height).flat_map(|y| (0..to.width).map(move |x| (y, x)));
        let class = |(y, x)| {
            let source = centre(y, from.height, to.height) * from.width;
            classes[source + centre(x, from.width, to.width)]
        };
        Some(pixels.map(class).collect())
    }

    forward!(metrics, privileged, simulator);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::Script;

    #[test]
    fn pixels_are_means_of_areas() {
        let mut env = Resize::new(Script::of_length(3).boxed(), 1, 2);
        assert_eq!(env.spec().image.bytes(), 6);
        // The script's image is the seed, least byte first: four pixels of 3 bytes, the last one of zeros.
        let seed = u64::from_le_bytes([10, 20, 30, 100, 100, 100, 20, 40]);
        let row = env.reset(seed).unwrap();
        assert_eq!(row.image, [15, 30, 15, 50, 50, 50]);
        assert_eq!(env.segmentation(), Some(vec![2, 0]));
    }

    #[test]
    fn enlarging_repeats_pixels() {
        let mut env = Resize::new(Script::of_length(3).boxed(), 4, 4);
        let seed = u64::from_le_bytes([10, 20, 30, 100, 100, 100, 20, 40]);
        let row = env.reset(seed).unwrap();
        assert_eq!(
            row.image[..12],
            [10, 20, 30, 10, 20, 30, 100, 100, 100, 100, 100, 100]
        );
        let expected = vec![0, 0, 1, 1, 0, 0, 1, 1, 2, 2, 0, 0, 2, 2, 0, 0];
        assert_eq!(env.segmentation(), Some(expected));
    }
}
