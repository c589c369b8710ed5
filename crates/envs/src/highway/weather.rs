//! Weather that drifts as in the paper's CARLA setup: the sun's height swings, and storms come and go.
//!
//! There it goes on from episode to episode and is never reset; here an episode draws where in that course it starts,
//! so that a seed is an episode, and episodes together still show all of it.

use std::f64::consts::TAU;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Weather's time per simulator frame.
const PER_FRAME: f64 = 0.1;
const SUN_RAD: f64 = 0.008;
const STORM: f64 = 1.3;
const LEAST_STORM: f64 = -250.0;
const GREATEST_STORM: f64 = 100.0;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Weather {
    sun_phase_rad: f64,
    storm: f64,
    storm_grows: bool,
}

impl Weather {
    /// Somewhere in the course of the weather.
    pub(crate) fn random(rng: &mut ChaCha8Rng) -> Self {
        Self {
            sun_phase_rad: rng.random_range(0.0..TAU),
            storm: rng.random_range(LEAST_STORM..GREATEST_STORM),
            storm_grows: rng.random(),
        }
    }

    /// One simulator frame.
    pub(crate) fn step(&mut self) {
        self.sun_phase_rad = (self.sun_phase_rad + SUN_RAD * PER_FRAME) % TAU;
        let change = STORM * PER_FRAME;
        self.storm += if self.storm_grows { change } else { -change };
        if self.storm >= GREATEST_STORM {
            self.storm_grows = false;
        } else if self.storm <= LEAST_STORM {
            self.storm_grows = true;
        }
    }

    /// How high the sun stands, 20 to 90 degrees.
    pub(crate) fn sun_altitude_deg(&self) -> f64 {
        55.0 + 35.0 * self.sun_phase_rad.sin()
    }

    /// Clouds, 0 to 60 percent.
    pub(crate) fn clouds_percent(&self) -> f64 {
        (self.storm + 40.0).clamp(0.0, 60.0)
    }

    /// Rain, 0 to 80 percent.
    pub(crate) fn rain_percent(&self) -> f64 {
        self.storm.clamp(0.0, 80.0)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use rand::SeedableRng;

    use super::*;

    /// Weather with the sun at one end of its swing.
    pub(crate) fn weather(high_sun: bool, storm: f64) -> Weather {
        Weather {
            sun_phase_rad: if high_sun { 0.25 * TAU } else { 0.75 * TAU },
            storm,
            storm_grows: true,
        }
    }

    #[test]
    fn matches_the_formula_by_hand() {
        let mut weather = weather(true, -50.0);
        assert_eq!(weather.sun_altitude_deg(), 90.0);
        for _ in 0..1_000 {
            weather.step();
        }
        // An episode: the sun by .8 rad, the storm by 130 to 80.
        assert!((weather.sun_altitude_deg() - (55.0 + 35.0 * 0.8_f64.cos())).abs() < 1e-9);
        assert!((weather.rain_percent() - 80.0).abs() < 1e-9);
        assert_eq!(weather.clouds_percent(), 60.0);
    }

    #[test]
    fn everything_between_the_bounds_comes_again_and_again() {
        let mut weather = Weather::random(&mut ChaCha8Rng::seed_from_u64(1));
        let (mut lowest, mut highest) = (f64::INFINITY, 0.0_f64);
        let (mut dry, mut wet) = (0, 0);
        for _ in 0..40_000 {
            weather.step();
            lowest = lowest.min(weather.sun_altitude_deg());
            highest = highest.max(weather.sun_altitude_deg());
            dry += usize::from(weather.clouds_percent() == 0.0);
            wet += usize::from(weather.rain_percent() > 0.0);
        }
        assert!((20.0..20.1).contains(&lowest) && (89.9..=90.0).contains(&highest));
        // 210 of 350 are without clouds, 100 with rain.
        assert!((20_000..28_000).contains(&dry), "{dry}");
        assert!((9_000..14_000).contains(&wet), "{wet}");
    }
}
