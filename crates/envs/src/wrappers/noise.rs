//! Noisy observations.

use isodream_core::derive_seed;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::forward;
use crate::environment::class;
use crate::noise::NoiseTable;
use crate::{EnvError, Environment, GaussianNoise, NoiseTarget, Transition};

/// Adds [`GaussianNoise`] to every observation, drawn from the episode's seed.
pub struct Noisy {
    env: Box<dyn Environment>,
    target: NoiseTarget,
    table: NoiseTable,
    rng: ChaCha8Rng,
}

impl Noisy {
    /// Adds `noise` to what `env` shows.
    ///
    /// # Errors
    /// If `sigma` is not between 0 and 255, or if images are not RGB.
    pub fn new(env: Box<dyn Environment>, noise: GaussianNoise) -> Result<Self, EnvError> {
        let GaussianNoise { sigma, target } = noise;
        let invalid = |field, value: String, expected| EnvError::InvalidConfig {
            field,
            value,
            expected,
        };
        if !(0.0..=255.0).contains(&sigma) {
            return Err(invalid(
                "noise sigma",
                sigma.to_string(),
                "between 0 and 255",
            ));
        }
        let channels = env.spec().image.channels;
        if channels != 3 {
            return Err(invalid(
                "image channels",
                channels.to_string(),
                "3 for noise",
            ));
        }
        Ok(Self {
            env,
            target,
            table: NoiseTable::new(sigma),
            rng: ChaCha8Rng::seed_from_u64(0),
        })
    }

    fn noisy(&mut self, mut row: Transition) -> Result<Transition, EnvError> {
        match self.target {
            NoiseTarget::Image => self.table.add(&mut row.image, |_| true, &mut self.rng),
            NoiseTarget::Background => {
                let classes = self
                    .env
                    .segmentation()
                    .ok_or_else(|| EnvError::NoSegmentation {
                        id: self.env.spec().id.clone(),
                    })?;
                let is_noisy = |number| classes.get(number) == Some(&class::BACKGROUND);
                self.table.add(&mut row.image, is_noisy, &mut self.rng);
            }
        }
        Ok(row)
    }
}

impl Environment for Noisy {
    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        self.rng = ChaCha8Rng::seed_from_u64(derive_seed(seed, &["noise"]));
        let row = self.env.reset(seed)?;
        self.noisy(row)
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        let row = self.env.step(action)?;
        self.noisy(row)
    }

    forward!(spec, segmentation, metrics, privileged, simulator);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::Script;

    fn noisy(sigma: f32, target: NoiseTarget) -> Noisy {
        Noisy::new(
            Script::of_length(9).boxed(),
            GaussianNoise { sigma, target },
        )
        .unwrap()
    }

    #[test]
    fn noise_is_the_seeds() {
        let mut env = noisy(40.0, NoiseTarget::Image);
        let mut episode = |seed| [env.reset(seed).unwrap(), env.step(&[0.0]).unwrap()];
        let (first, other, again) = (episode(5), episode(6), episode(5));
        assert_eq!(first, again);
        assert_ne!(first[0].image, other[0].image);
        let clean = Script::of_length(9).reset(5).unwrap();
        assert_ne!(first[0].image, clean.image);
        assert_eq!(first[1].reward, 1.0);
    }

    #[test]
    fn a_noisy_background_leaves_the_rest() {
        // Classes are 0, 1, 2, 0.
        let mut env = noisy(80.0, NoiseTarget::Background);
        let (clean, dirty) = (
            Script::of_length(9).reset(5).unwrap(),
            env.reset(5).unwrap(),
        );
        assert_eq!(clean.image[3..9], dirty.image[3..9]);
        assert_ne!(clean.image, dirty.image);
    }

    #[test]
    fn impossible_noise_is_refused() {
        for sigma in [-1.0, f32::NAN, 256.0] {
            let noise = GaussianNoise {
                sigma,
                ..GaussianNoise::default()
            };
            assert!(Noisy::new(Script::of_length(1).boxed(), noise).is_err());
        }
    }
}
