//! How much an environment was used, and how fast it is.

use std::time::{Duration, Instant};

use super::forward;
use crate::{EnvError, Environment, Transition};

/// Adds to the metrics: `frames` and `steps` of the episode, `episodes` begun, and `frames_per_s`, the
/// episode's frames (action repeat counted) by the time that its steps took. Only this last one may differ
/// between runs of one seed.
pub struct Statistics {
    env: Box<dyn Environment>,
    episodes: u64,
    steps: u64,
    stepping: Duration,
}

impl Statistics {
    /// Counts and times the steps of `env`.
    pub fn new(env: Box<dyn Environment>) -> Self {
        Self {
            env,
            episodes: 0,
            steps: 0,
            stepping: Duration::ZERO,
        }
    }
}

impl Environment for Statistics {
    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        let row = self.env.reset(seed)?;
        self.episodes += 1;
        self.steps = 0;
        self.stepping = Duration::ZERO;
        Ok(row)
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        let started = Instant::now();
        let row = self.env.step(action)?;
        self.stepping += started.elapsed();
        self.steps += 1;
        Ok(row)
    }

    fn metrics(&self) -> Vec<(&'static str, f64)> {
        let frames = (self.steps * u64::from(self.env.spec().action_repeat)) as f64;
        let mut metrics = self.env.metrics();
        metrics.push(("frames", frames));
        metrics.push(("steps", self.steps as f64));
        metrics.push(("episodes", self.episodes as f64));
        if !self.stepping.is_zero() {
            metrics.push(("frames_per_s", frames / self.stepping.as_secs_f64()));
        }
        metrics
    }

    forward!(spec, segmentation, privileged, simulator);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::Script;

    #[test]
    fn frames_steps_and_episodes_are_counted() {
        let mut script = Script::of_length(9);
        script.spec.action_repeat = 4;
        let mut env = Statistics::new(script.boxed());
        for seed in 0..3 {
            env.reset(seed).unwrap();
            for _ in 0..5 {
                env.step(&[0.0]).unwrap();
            }
        }
        let metrics = env.metrics();
        assert_eq!(
            metrics[1..4],
            [("frames", 20.0), ("steps", 5.0), ("episodes", 3.0)]
        );
        assert!(metrics[4].0 == "frames_per_s" && metrics[4].1 > 0.0);
    }
}
