//! A traffic jam: the ego's lane and those to the right of it crawl, those to the left flow densely.
//!
//! Whoever waits for a gap in which nobody has to brake crawls on for most of the episode. Whoever knows that the
//! others will brake cuts in: the sparse dependency of the Iso-Dream++ paper, with a price on not knowing of it.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use crate::highway::car::Car;
use crate::highway::ego;
use crate::highway::following::{Leader, Temper, acceleration};
use crate::highway::road::{LANES, Road};

/// Speed of the lanes that crawl, and of those that flow.
const CRAWL_M_S: f64 = 2.5;
const FLOW_M_S: f64 = 7.0;
/// A lane that flows holds so many times the cars of one that crawls.
const FLOW_SHARE: usize = 2;
/// How much faster than its lane a car drives to close a gap.
const CLOSING_UP: f64 = 1.2;
/// Nobody in a jam drives as fast as wanted: that is what keeps the gaps closed.
const DESIRED_M_S: f64 = 12.0;

/// Where cars leave the jam around the ego, for the other end of their lane.
const BEHIND_M: f64 = 60.0;
const AHEAD_M: f64 = 110.0;
/// No car appears nearer than this to the ego: behind it the camera does not look, and ahead a car is a pixel.
const APPEAR_BEHIND_M: f64 = 20.0;
const APPEAR_AHEAD_M: f64 = 80.0;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Jam {
    /// The lanes to the right of this one crawl.
    first_flowing: usize,
}

impl Jam {
    /// The jam around an ego that starts in `ego_lane`.
    pub(crate) fn around(ego_lane: usize) -> Self {
        Self {
            first_flowing: ego_lane + 1,
        }
    }

    fn pace_m_s(self, lane: usize) -> f64 {
        if lane < self.first_flowing {
            CRAWL_M_S
        } else {
            FLOW_M_S
        }
    }

    /// The acceleration of a car in `lane` at `speed` behind `leader`. The first one follows an unseen car, as the
    /// jam goes on beyond the cars that are simulated.
    pub(crate) fn acceleration(
        self,
        lane: usize,
        temper: &Temper,
        speed: f64,
        leader: Option<Leader>,
    ) -> f64 {
        let pace = self.pace_m_s(lane);
        let unseen = |speed_m_s| Leader {
            gap_m: steady_gap(temper, speed_m_s),
            speed_m_s,
        };
        if leader.is_none() {
            return acceleration(temper, speed, Some(unseen(pace)));
        }
        let closing_up = acceleration(temper, speed, Some(unseen(CLOSING_UP * pace)));
        acceleration(temper, speed, leader).min(closing_up)
    }

    fn car(self, rng: &mut ChaCha8Rng, lane: usize) -> Car {
        let mut car = Car::random(rng, lane, 0.0);
        car.temper.desired_m_s = DESIRED_M_S;
        car.temper.headway_s = rng.random_range(0.75..1.05);
        car.speed = self.pace_m_s(lane);
        car
    }

    /// From a car's middle to that of the one ahead, both at the lane's pace.
    fn spacing(self, follower: &Car, leader_half_length: f64) -> f64 {
        let gap = steady_gap(&follower.temper, self.pace_m_s(follower.lane));
        follower.half_length() + gap + leader_half_length
    }

    /// `count` cars in four columns before and behind `s`, where the ego starts.
    pub(crate) fn initial(
        self,
        road: &Road,
        rng: &mut ChaCha8Rng,
        count: usize,
        s: f64,
    ) -> Vec<Car> {
        let ego_lane = self.first_flowing - 1;
        let weight = |lane: usize| {
            if lane < self.first_flowing {
                1
            } else {
                FLOW_SHARE
            }
        };
        let weights: usize = (0..LANES).map(weight).sum();
        let mut cars = Vec::with_capacity(count);
        let mut dealt = 0;
        let mut weighed = 0;
        for lane in (0..LANES).rev() {
            weighed += weight(lane);
            let share = count * weighed / weights - dealt;
            dealt += share;
            // The camera looks ahead: most of the cars are there.
            let ahead = (2 * share).div_ceil(3);
            let phase = rng.random_range(0.0..1.0);
            let half_length = if lane == ego_lane {
                ego::LENGTH / 2.0
            } else {
                0.0
            };
            let (mut front, mut leader) = (0.0, half_length);
            for _ in 0..ahead {
                let car = self.car(rng, lane);
                let first = front == 0.0 && lane != ego_lane;
                front += self.spacing(&car, leader) * if first { phase } else { 1.0 };
                leader = car.half_length();
                cars.push(at(road, car, s + front));
            }
            let (mut rear, mut leader) = (0.0, half_length);
            for _ in ahead..share {
                let car = self.car(rng, lane);
                let first = rear == 0.0 && lane != ego_lane;
                rear += self.spacing(&car, leader) * if first { 1.0 - phase } else { 1.0 };
                leader = car.half_length();
                cars.push(at(road, car, s - rear));
            }
        }
        cars
    }

    /// Moves cars that left the surroundings of the ego, at `reference_s`, to the other end of their lane.
    pub(crate) fn recycle(
        self,
        road: &Road,
        rng: &mut ChaCha8Rng,
        cars: &mut [Car],
        reference_s: f64,
    ) {
        for index in 0..cars.len() {
            let ahead = road.ahead(reference_s, cars[index].at.s);
            if (-BEHIND_M..=AHEAD_M).contains(&ahead) {
                continue;
            }
            let mut fresh = self.car(rng, cars[index].lane);
            let others = (cars.iter().enumerate())
                .filter(|(other, car)| *other != index && car.lane == fresh.lane)
                .map(|(_, car)| (road.ahead(reference_s, car.at.s), car));
            let place = if ahead < 0.0 {
                let first = others.max_by(|a, b| a.0.total_cmp(&b.0));
                let next = first.map(|(s, car)| s + self.spacing(car, fresh.half_length()));
                next.map_or(APPEAR_AHEAD_M, |s| s.max(APPEAR_AHEAD_M))
            } else {
                let last = others.min_by(|a, b| a.0.total_cmp(&b.0));
                fresh.speed = last.map_or(fresh.speed, |(_, car)| fresh.speed.min(car.speed));
                let next = last.map(|(s, car)| s - self.spacing(&fresh, car.half_length()));
                next.map_or(-APPEAR_BEHIND_M, |s| s.min(-APPEAR_BEHIND_M))
            };
            // A full lane is tried again in the next frame.
            if (-BEHIND_M..=AHEAD_M).contains(&place) {
                cars[index] = at(road, fresh, reference_s + place);
            }
        }
    }
}

fn at(road: &Road, mut car: Car, s: f64) -> Car {
    car.at.s = road.wrap(s);
    car
}

/// The gap at which a car holds `speed` behind a leader of the same speed.
fn steady_gap(temper: &Temper, speed: f64) -> f64 {
    let free = 1.0 - (speed / temper.desired_m_s).powi(4);
    (temper.gap_m + speed * temper.headway_s) / free.sqrt()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;
    use crate::highway::collision::first_contact;
    use crate::highway::ego::DT;
    use crate::highway::maps::Map;
    use crate::highway::traffic::Traffic;

    #[test]
    fn at_the_steady_gap_nobody_accelerates() {
        let jam = Jam::around(1);
        let car = jam.car(&mut ChaCha8Rng::seed_from_u64(1), 2);
        let first = |speed| jam.acceleration(2, &car.temper, speed, None);
        assert!(first(FLOW_M_S).abs() < 1e-9);
        assert!(first(FLOW_M_S - 1.0) > 0.2 && first(FLOW_M_S + 1.0) < -0.2);
    }

    #[test]
    fn lanes_keep_their_pace_without_collisions_wherever_the_ego_drives() {
        let road = Map::Straight.road();
        for (count, ego_lane, ego_speed) in [(30, 1, 2.5), (30, 0, 7.0), (60, 2, 0.0), (8, 1, 5.0)]
        {
            let mut reference = 1_500.0;
            let rng = ChaCha8Rng::seed_from_u64(4);
            let mut traffic = Traffic::jammed(road, rng, count, reference, ego_lane);
            assert_eq!(traffic.cars.len(), count);
            for tick in 0..2_000 {
                reference += ego_speed * DT;
                traffic.step(road, reference, None);
                assert_eq!(first_contact(road, &traffic.cars), None, "{count} {tick}");
            }
            for car in &traffic.cars {
                let pace = Jam::around(ego_lane).pace_m_s(car.lane);
                assert!(
                    (0.8 * pace..1.21 * pace).contains(&car.speed),
                    "{} in {}",
                    car.speed,
                    car.lane
                );
            }
        }
    }
}
