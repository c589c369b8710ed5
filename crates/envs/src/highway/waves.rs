//! Stop-and-go waves: in each lane, stretches of slow and of fast traffic alternate and travel upstream, as on a crowded
//! motorway. Lanes further left are faster, and their waves are higher.
//!
//! Nothing but place and time decides on the pace, and the cars ahead show it: they slow down earlier.

use std::f64::consts::PI;
use std::ops::Range;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use crate::highway::road::{LANES, Road};

/// Pace in the middle of a slow stretch, by lane. Nobody comes to a stop.
const SLOW_M_S: [f64; LANES] = [2.0, 2.1, 2.6, 3.5];
/// Pace in the middle of a fast stretch, by lane. On the left it is beyond what most cars want to drive.
const FAST_M_S: [f64; LANES] = [4.2, 5.0, 11.4, 29.0];
/// From one slow stretch of a lane to the next.
const LENGTH_M: Range<f64> = 240.0..360.0;
/// Speed of the waves against the direction of travel.
const UPSTREAM_M_S: f64 = 5.0;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Waves {
    lanes: [Wave; LANES],
    seconds: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Wave {
    /// Slow stretches per metre, times pi.
    number: f64,
    phase: f64,
}

impl Waves {
    /// Each lane has its own length and phase. A whole number of waves fits on a loop.
    pub(crate) fn random(road: &Road, rng: &mut ChaCha8Rng) -> Self {
        let lanes = std::array::from_fn(|_| {
            let count = road.length() / rng.random_range(LENGTH_M);
            Wave {
                number: PI * count.round().max(1.0) / road.length(),
                phase: rng.random_range(0.0..PI),
            }
        });
        Self {
            lanes,
            seconds: 0.0,
        }
    }

    /// Waves whose fast stretches have their middles at `s`, in every lane.
    #[cfg(test)]
    pub(crate) fn fastest_at(road: &Road, s: f64) -> Self {
        let number = PI / road.length();
        let phase = -number * s;
        Self {
            lanes: [Wave { number, phase }; LANES],
            seconds: 0.0,
        }
    }

    pub(crate) fn advance(&mut self, seconds: f64) {
        self.seconds += seconds;
    }

    /// Speed of the traffic in `lane` at `s`.
    pub(crate) fn pace_m_s(&self, lane: usize, s: f64) -> f64 {
        let wave = &self.lanes[lane];
        let angle = wave.number * (s + UPSTREAM_M_S * self.seconds) + wave.phase;
        let (slow, fast) = (SLOW_M_S[lane], FAST_M_S[lane]);
        slow + (fast - slow) * angle.cos().abs()
    }
}
