//! One car of the traffic: its body, its driver, and how it moves along and across the road.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use crate::geometry::Vec2;
use crate::highway::ego::DT;
use crate::highway::following::Temper;
use crate::highway::road::{BARRIER_D, Frenet, Road, lane_center, lanes_overlapped};

/// Sideways acceleration and speed that a driver uses in a lane change.
const SIDEWAYS_M_S2: f64 = 3.0;
const SIDEWAYS_M_S: f64 = 1.4;
/// Share of the distance to the lane's centre that a driver closes per second.
const CENTRING_PER_S: f64 = 0.9;
/// Closer than this to its lane's centre a lane change is over.
const CENTRED_M: f64 = 0.3;

/// A driver who is shoved brakes by this much per N s of [`Car::shoved_ns`], up to the most.
const SHOVE_BRAKE_PER_NS: f64 = 0.02;
const SHOVE_BRAKE_M_S2: f64 = 9.0;
/// Nobody stops in the middle of a highway for being shoved: drivers brake down to a crawl, less and less as they come
/// near it.
const CRAWL_M_S: f64 = 0.4;
const NEAR_CRAWL_M_S: f64 = 0.2;
/// The time constant with which a shove is forgotten, and over which small ones add up.
const SHOVES_ADD_UP_S: f64 = 0.4;
/// Speed on an empty road.
const LEAST_M_S: f64 = 18.0;
const MOST_M_S: f64 = 24.0;
/// How much slower or faster than its lane a car drives where it can.
const EAGERNESS: std::ops::Range<f64> = 0.9..1.15;

/// Outer form of a car.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Build {
    Compact,
    Sedan,
    Suv,
    Van,
}

impl Build {
    const ALL: [Self; 4] = [Self::Compact, Self::Sedan, Self::Suv, Self::Van];

    /// Length, width and height in metres.
    pub(crate) fn size(self) -> [f64; 3] {
        match self {
            Self::Compact => [3.8, 1.7, 1.45],
            Self::Sedan => [4.6, 1.8, 1.42],
            Self::Suv => [4.7, 1.9, 1.75],
            Self::Van => [5.4, 2.0, 2.35],
        }
    }

    pub(crate) fn mass_kg(self) -> f64 {
        match self {
            Self::Compact => 1100.0,
            Self::Sedan => 1500.0,
            Self::Suv => 1900.0,
            Self::Van => 2400.0,
        }
    }
}

/// Half the length of the longest of all, the ego included.
pub(crate) const LONGEST_HALF_M: f64 = 2.7;

/// What every car says about itself to those around it, the ego included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Body {
    pub(crate) s: f64,
    pub(crate) half_length: f64,
    pub(crate) speed: f64,
    /// Bit `i` is set if the body, or a running lane change, takes up lane `i`.
    pub(crate) lanes: u8,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Car {
    pub(crate) at: Frenet,
    pub(crate) speed: f64,
    /// Speed to the left.
    pub(crate) sideways: f64,
    pub(crate) lane: usize,
    pub(crate) acceleration: f64,
    pub(crate) temper: Temper,
    pub(crate) build: Build,
    pub(crate) paint: u8,
    pub(crate) until_decision_s: f64,
    /// Its speed where it can choose, in paces of its lane.
    pub(crate) eagerness: f64,
    /// Impulse from the ego that the driver still feels.
    shoved_ns: f64,
}

impl Car {
    /// A random driver in a random car at rest in the middle of `lane`.
    pub(crate) fn random(rng: &mut ChaCha8Rng, lane: usize, s: f64) -> Self {
        let build = Build::ALL[rng.random_range(0..Build::ALL.len())];
        Self {
            at: Frenet {
                s,
                d: lane_center(lane),
            },
            speed: 0.0,
            sideways: 0.0,
            lane,
            acceleration: 0.0,
            temper: Temper {
                desired_m_s: rng.random_range(LEAST_M_S..MOST_M_S),
                gap_m: rng.random_range(2.0..3.5),
                headway_s: rng.random_range(0.7..1.2),
                accelerate_m_s2: rng.random_range(1.5..3.0),
                brake_m_s2: rng.random_range(2.5..5.0),
            },
            build,
            paint: rng.random(),
            until_decision_s: rng.random_range(0.0..1.0),
            eagerness: rng.random_range(EAGERNESS),
            shoved_ns: 0.0,
        }
    }

    pub(crate) fn half_length(&self) -> f64 {
        self.build.size()[0] / 2.0
    }

    pub(crate) fn half_width(&self) -> f64 {
        self.build.size()[1] / 2.0
    }

    pub(crate) fn body(&self) -> Body {
        Body {
            s: self.at.s,
            half_length: self.half_length(),
            speed: self.speed,
            lanes: lanes_overlapped(self.at.d, self.half_width()) | 1 << self.lane,
        }
    }

    pub(crate) fn is_changing_lane(&self) -> bool {
        (lane_center(self.lane) - self.at.d).abs() > CENTRED_M
    }

    pub(crate) fn yaw(&self, road: &Road) -> f64 {
        road.heading(self.at.s) + self.sideways.atan2(self.speed.max(4.0))
    }

    pub(crate) fn velocity(&self, road: &Road) -> Vec2 {
        let tangent = road.tangent(self.at.s);
        tangent * self.speed + tangent.left() * self.sideways
    }

    /// How this driver follows others where the traffic's pace is `pace_m_s`.
    pub(crate) fn temper_at(&self, pace_m_s: f64) -> Temper {
        let desired_m_s = (self.eagerness * pace_m_s).min(self.temper.desired_m_s);
        Temper {
            desired_m_s,
            ..self.temper
        }
    }

    /// Tells the driver of an impulse on the car.
    pub(crate) fn shove(&mut self, impulse_ns: f64) {
        self.shoved_ns = (self.shoved_ns + impulse_ns).min(SHOVE_BRAKE_M_S2 / SHOVE_BRAKE_PER_NS);
    }

    /// What a driver who is shoved makes of the acceleration that traffic asks for: the harder the shove, the less of it
    /// is left, down to a crawl, so that pushing others along does not pay. It drives on once it is let go.
    pub(crate) fn under_shove(&self, wanted: f64) -> f64 {
        let above = (self.speed - CRAWL_M_S) / NEAR_CRAWL_M_S;
        wanted - SHOVE_BRAKE_PER_NS * self.shoved_ns * above.clamp(0.0, 1.0)
    }

    /// Replaces the velocity, as a collision does. A pushed car may slide sideways but does not roll backwards.
    pub(crate) fn set_velocity(&mut self, road: &Road, velocity: Vec2) {
        let tangent = road.tangent(self.at.s);
        self.speed = velocity.dot(tangent).max(0.0);
        self.sideways = velocity.dot(tangent.left());
    }

    /// Shifts the car in the world, as far as the barriers allow.
    pub(crate) fn shift(&mut self, road: &Road, by: Vec2) {
        let tangent = road.tangent(self.at.s);
        self.at.s = road.wrap(self.at.s + by.dot(tangent));
        self.at.d += by.dot(tangent.left());
        self.keep_between_barriers();
    }

    fn keep_between_barriers(&mut self) {
        let limit = BARRIER_D - self.half_width();
        if self.at.d.abs() > limit {
            self.at.d = self.at.d.clamp(-limit, limit);
            self.sideways = 0.0;
        }
    }

    /// One frame at the acceleration that was decided.
    pub(crate) fn advance(&mut self, road: &Road) {
        self.shoved_ns *= 1.0 - DT / SHOVES_ADD_UP_S;
        self.speed = (self.speed + self.acceleration * DT).max(0.0);
        let stretch = 1.0 - road.curvature(self.at.s) * self.at.d;
        self.at.s = road.wrap(self.at.s + self.speed / stretch * DT);

        // Wheels only carry a car sideways while they roll.
        let limit = SIDEWAYS_M_S.min(0.3 * self.speed);
        let wanted = ((lane_center(self.lane) - self.at.d) * CENTRING_PER_S).clamp(-limit, limit);
        let change = SIDEWAYS_M_S2 * DT;
        self.sideways += (wanted - self.sideways).clamp(-change, change);
        self.at.d += self.sideways * DT;
        self.keep_between_barriers();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::highway::ego;

    #[test]
    fn nobody_is_longer_than_the_longest() {
        let longest = Build::ALL.map(|build| build.size()[0] / 2.0);
        assert_eq!(longest.into_iter().fold(0.0, f64::max), LONGEST_HALF_M);
        assert!(ego::LENGTH.hypot(ego::WIDTH) / 2.0 < LONGEST_HALF_M);
    }
}
