//! What drivers earn.

use super::Driver;
use crate::{EnvError, Environment};

/// What a driver came to in some episodes.
#[derive(Debug, Clone, PartialEq)]
pub struct Score {
    /// Return of each episode.
    pub returns: Vec<f64>,
    /// Mean length of an episode, in agent steps.
    pub length: f64,
    /// Means of [`Environment::metrics`] at the ends of episodes.
    pub metrics: Vec<(&'static str, f64)>,
}

impl Score {
    /// Mean return.
    pub fn mean(&self) -> f64 {
        self.returns.iter().sum::<f64>() / self.count()
    }

    /// Standard deviation of the return over episodes.
    pub fn std(&self) -> f64 {
        let mean = self.mean();
        let squares = self.returns.iter().map(|value| (value - mean).powi(2));
        (squares.sum::<f64>() / self.count()).sqrt()
    }

    /// The mean of a metric, NaN where the environment has none of this name.
    pub fn metric(&self, name: &str) -> f64 {
        let found = self.metrics.iter().find(|(other, _)| *other == name);
        found.map_or(f64::NAN, |(_, value)| *value)
    }

    fn count(&self) -> f64 {
        self.returns.len().max(1) as f64
    }
}

/// Drives `episodes` episodes of `env`, seeds 0 and up, each with a fresh driver for its seed.
///
/// # Errors
/// As those of environment and driver.
pub fn score(
    env: &mut dyn Environment,
    episodes: u64,
    driver: &dyn Fn(u64) -> Box<dyn Driver>,
) -> Result<Score, EnvError> {
    let mut found = Score {
        returns: Vec::new(),
        length: 0.0,
        metrics: Vec::new(),
    };
    let share = 1.0 / episodes.max(1) as f64;
    for seed in 0..episodes {
        let mut driver = driver(seed);
        let mut row = env.reset(seed)?;
        let mut sum = 0.0;
        while !row.is_last {
            let action = driver.act(env)?;
            row = env.step(&action)?;
            sum += f64::from(row.reward);
            found.length += share;
        }
        found.returns.push(sum);
        for (index, (name, value)) in env.metrics().into_iter().enumerate() {
            if found.metrics.len() == index {
                found.metrics.push((name, 0.0));
            }
            found.metrics[index].1 += value * share;
        }
    }
    Ok(found)
}
