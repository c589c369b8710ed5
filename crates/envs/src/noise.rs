//! Gaussian noise on images.

pub use isodream_core::config::NoiseTarget;
use rand::{Rng, RngExt};

/// Quantiles in the table: draws are of 12 bits, the largest deviates by 3.7 sigma.
const QUANTILES: usize = 4096;

/// Independent noise on every channel of every pixel. The paper that tests with it names neither its strength
/// nor its target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GaussianNoise {
    /// Standard deviation, of 255.
    pub sigma: f32,
    /// Where.
    pub target: NoiseTarget,
}

impl Default for GaussianNoise {
    /// 25 of 255 on the whole image: clearly visible, and the common choice of work on denoising.
    fn default() -> Self {
        Self {
            sigma: 25.0,
            target: NoiseTarget::Image,
        }
    }
}

/// What a draw adds to a channel, by its 12 bits.
#[derive(Debug, Clone)]
pub(crate) struct NoiseTable(Vec<i16>);

impl NoiseTable {
    pub(crate) fn new(sigma: f32) -> Self {
        let entry = |index| {
            let probability = (index as f64 + 0.5) / QUANTILES as f64;
            (quantile(probability) * f64::from(sigma)).round() as i16
        };
        Self((0..QUANTILES).map(entry).collect())
    }

    /// Adds noise to the pixels of `image` `[H, W, 3]` for which `is_noisy` says so by their number. Every
    /// pixel takes its draws, noisy or not.
    pub(crate) fn add(
        &self,
        image: &mut [u8],
        is_noisy: impl Fn(usize) -> bool,
        rng: &mut impl Rng,
    ) {
        let (pixels, _) = image.as_chunks_mut::<3>();
        for (number, pixel) in pixels.iter_mut().enumerate() {
            let draws: u64 = rng.random();
            if is_noisy(number) {
                for (place, channel) in pixel.iter_mut().enumerate() {
                    let draw = (draws >> (12 * place)) as usize % QUANTILES;
                    let noisy = i16::from(*channel).saturating_add(self.0[draw]);
                    *channel = noisy.clamp(0, 255) as u8;
                }
            }
        }
    }
}

/// The standard normal distribution's quantile, by bisection of its distribution function: the table is made
/// once.
fn quantile(probability: f64) -> f64 {
    let (mut low, mut high) = (-8.0, 8.0);
    for _ in 0..50 {
        let middle = (low + high) / 2.0;
        if distribution(middle) < probability {
            low = middle;
        } else {
            high = middle;
        }
    }
    (low + high) / 2.0
}

/// Its distribution function, within 1e-12 for `|x| < 5`: a series of positive terms.
fn distribution(x: f64) -> f64 {
    let mut term = x;
    let mut sum = x;
    for index in 1..120 {
        term *= x * x / f64::from(2 * index + 1);
        sum += term;
    }
    0.5 + sum * (-x * x / 2.0).exp() / (2.0 * std::f64::consts::PI).sqrt()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn quantiles_match_tables() {
        for (probability, expected) in [
            (0.5, 0.0),
            (0.841_344_746, 1.0),
            (0.975, 1.959_964),
            (0.001, -3.090_232),
        ] {
            let error = (quantile(probability) - expected).abs();
            assert!(error < 1e-5, "{probability}: {error}");
        }
    }

    #[test]
    fn noise_has_the_mean_and_deviation_asked_for() {
        let table = NoiseTable::new(25.0);
        let mut image = vec![128; 64 * 64 * 3];
        table.add(&mut image, |_| true, &mut ChaCha8Rng::seed_from_u64(3));
        let offsets = image.iter().map(|byte| f64::from(*byte) - 128.0);
        let count = image.len() as f64;
        let mean = offsets.clone().sum::<f64>() / count;
        let deviation = (offsets.map(|offset| offset * offset).sum::<f64>() / count).sqrt();
        // Four standard errors: .9 and .64.
        assert!(mean.abs() < 0.9, "{mean}");
        assert!((deviation - 25.0).abs() < 0.64, "{deviation}");
    }

    #[test]
    fn only_the_target_is_noisy_and_bytes_do_not_wrap() {
        let table = NoiseTable::new(200.0);
        let mut image = [0, 255, 128].repeat(50);
        table.add(
            &mut image,
            |number| number < 25,
            &mut ChaCha8Rng::seed_from_u64(3),
        );
        assert_eq!(image[75..], [0, 255, 128].repeat(25));
        let dark = image[..75]
            .iter()
            .step_by(3)
            .filter(|&&byte| byte == 0)
            .count();
        assert!(
            (6..20).contains(&dark),
            "half of the draws stay below 0: {dark}"
        );
    }
}
