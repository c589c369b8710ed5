//! The cars around the ego, and what they decide in each frame.

use rand_chacha::ChaCha8Rng;

use crate::highway::car::{Body, Car};
use crate::highway::collision;
use crate::highway::column::{Column, Neighbour};
use crate::highway::ego::DT;
use crate::highway::following::acceleration;
use crate::highway::lane_change::decide;
use crate::highway::road::{LANES, Road};
use crate::highway::spawn;
use crate::highway::waves::Waves;

const DECISION_EVERY_S: f64 = 1.0;
/// The ego counts as having taken a lane for this long.
pub(crate) const TAKEN_S: f64 = 3.0;
/// Braking, and braking on account of the ego, that make an interaction.
const INTERACTION_M_S2: f64 = 0.5;

/// The ego as the traffic sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct EgoBody {
    pub(crate) body: Body,
    /// Lanes that the ego has taken within the last [`TAKEN_S`].
    pub(crate) taken: u8,
}

#[derive(Debug, Clone)]
pub(crate) struct Traffic {
    pub(crate) cars: Vec<Car>,
    /// The first two cars that touched each other in the newest frame.
    pub(crate) touching: Option<(usize, usize)>,
    column: Column,
    close: Vec<(usize, usize)>,
    rng: ChaCha8Rng,
    waves: Waves,
}

impl Traffic {
    /// `count` cars around `s`, leaving room for the ego in `ego_lane`.
    pub(crate) fn new(
        road: &Road,
        mut rng: ChaCha8Rng,
        count: usize,
        s: f64,
        ego_lane: usize,
    ) -> Self {
        let waves = Waves::random(road, &mut rng);
        let cars = spawn::initial(road, &mut rng, count, s, ego_lane);
        Self {
            cars,
            touching: None,
            column: Column::default(),
            close: Vec::new(),
            rng,
            waves,
        }
    }

    /// One frame; whether a car had to brake because the ego took its lane.
    pub(crate) fn step(&mut self, road: &Road, reference_s: f64, ego: Option<&EgoBody>) -> bool {
        self.waves.advance(DT);
        spawn::recycle(
            road,
            &mut self.rng,
            &self.waves,
            &mut self.cars,
            reference_s,
            ego,
        );
        let bodies = self.cars.iter().map(Car::body);
        self.column
            .arrange(road, reference_s, bodies.chain(ego.map(|ego| ego.body)));

        let interaction = self.follow(road, ego);
        self.change_lanes(road);
        for car in &mut self.cars {
            car.advance(road);
        }
        self.column
            .close_pairs(self.cars.len(), collision::MAY_TOUCH_M, &mut self.close);
        self.touching = collision::separate_cars(road, &mut self.cars, &self.close);
        interaction
    }

    fn follow(&mut self, road: &Road, ego: Option<&EgoBody>) -> bool {
        let ego_index = self.cars.len();
        let mut interaction = false;
        for (index, car) in self.cars.iter_mut().enumerate() {
            let lanes = self.column.body(index).lanes;
            let ahead = self.column.ahead_of(road, index, lanes, None);
            let followed = ahead.map(Neighbour::as_leader);
            let temper = car.temper_at(self.waves.pace_m_s(car.lane, car.at.s));
            let wanted = acceleration(&temper, car.speed, followed);
            car.acceleration = car.under_shove(wanted);
            let Some(ego) = ego.filter(|_| ahead.is_some_and(|leader| leader.index == ego_index))
            else {
                continue;
            };
            if wanted < -INTERACTION_M_S2 && lanes & ego.taken != 0 {
                let other = self.column.ahead_of(road, index, lanes, Some(ego_index));
                let alone = acceleration(&temper, car.speed, other.map(Neighbour::as_leader));
                interaction |= alone - wanted > INTERACTION_M_S2;
            }
        }
        interaction
    }

    fn change_lanes(&mut self, road: &Road) {
        for index in 0..self.cars.len() {
            self.cars[index].until_decision_s -= DT;
            if self.cars[index].until_decision_s > 0.0 {
                continue;
            }
            self.cars[index].until_decision_s += DECISION_EVERY_S;
            if let Some(lane) = decide(road, &self.cars, &self.column, index) {
                debug_assert!(lane < LANES);
                self.cars[index].lane = lane;
                // Those who decide later in this frame must already see the lane as taken.
                self.column.set_lanes(index, self.cars[index].body().lanes);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;
    use crate::highway::maps::Map;
    use crate::highway::road::{Frenet, lane_center};

    #[test]
    fn traffic_alone_never_collides() {
        let road = Map::Loop.road();
        for seed in 0..3 {
            let mut traffic = Traffic::new(road, ChaCha8Rng::seed_from_u64(seed), 30, 500.0, 0);
            let mut reference = 500.0;
            let mut distance = 0.0;
            let mut changes = 0;
            for tick in 0..2_000 {
                reference += 11.0 * DT;
                let before: Vec<usize> = traffic.cars.iter().map(|car| car.lane).collect();
                traffic.step(road, road.wrap(reference), None);
                changes += traffic
                    .cars
                    .iter()
                    .zip(before)
                    .filter(|(car, lane)| car.lane != *lane)
                    .count();
                distance += traffic.cars.iter().map(|car| car.speed * DT).sum::<f64>();
                let contact = collision::first_contact(road, &traffic.cars);
                assert_eq!(contact, None, "seed {seed} tick {tick}");
            }
            let mean_speed = distance / 30.0 / (2_000.0 * DT);
            println!("seed {seed}: mean speed {mean_speed:.1}, lane changes {changes}");
            assert!(mean_speed > 4.5, "traffic stands: {mean_speed}");
            assert!(changes > 30, "nobody changes lanes: {changes}");
        }
    }

    #[test]
    fn about_all_cars_stay_near_the_reference() {
        let road = Map::Loop.road();
        for ego_speed in [0.0, 11.0, 22.0] {
            let mut traffic = Traffic::new(road, ChaCha8Rng::seed_from_u64(5), 30, 500.0, 0);
            let mut reference = 500.0;
            for _ in 0..1_000 {
                reference += ego_speed * DT;
                traffic.step(road, road.wrap(reference), None);
            }
            let within = |metres: f64| {
                let here = road.wrap(reference);
                let cars = traffic.cars.iter();
                cars.filter(|car| road.ahead(here, car.at.s).abs() < metres)
                    .count()
            };
            let (near, around) = (within(100.0), within(210.0));
            println!("{ego_speed} m/s: {near} near, {around} around");
            assert!(
                near >= 13 && around >= 28,
                "{near}, {around} at {ego_speed} m/s"
            );
        }
    }

    #[test]
    fn a_follower_brakes_within_two_frames_of_a_cut_in() {
        let road = Map::Loop.road();
        let mut traffic = Traffic::new(road, ChaCha8Rng::seed_from_u64(1), 1, 500.0, 0);
        traffic.waves = Waves::fastest_at(road, 490.0);
        let follower = &mut traffic.cars[0];
        follower.lane = 3;
        follower.at.s = 480.0;
        follower.at.d = lane_center(3);
        follower.temper.desired_m_s = 14.0;
        follower.speed = 14.0;
        let mut body = Body {
            s: 500.0,
            half_length: 2.2,
            speed: 10.0,
            lanes: 0b0100,
        };
        for _ in 0..2 {
            let beside = EgoBody { body, taken: 0 };
            assert!(!traffic.step(road, 500.0, Some(&beside)));
            assert!(traffic.cars[0].acceleration > -0.5);
        }
        body.lanes = 0b1100;
        let cutting = EgoBody {
            body,
            taken: 0b1000,
        };
        let interaction = (0..2).any(|_| traffic.step(road, 500.0, Some(&cutting)));
        assert!(interaction);
        assert!(
            traffic.cars[0].acceleration < -1.0,
            "{}",
            traffic.cars[0].acceleration
        );
        assert!(traffic.cars[0].speed < 14.0);
    }

    #[test]
    fn following_an_ego_that_was_always_there_is_no_interaction() {
        let road = Map::Loop.road();
        let mut traffic = Traffic::new(road, ChaCha8Rng::seed_from_u64(1), 1, 500.0, 0);
        traffic.waves = Waves::fastest_at(road, 490.0);
        let follower = &mut traffic.cars[0];
        follower.lane = 3;
        follower.at.s = 480.0;
        follower.at.d = lane_center(3);
        follower.speed = 14.0;
        let body = Body {
            s: 500.0,
            half_length: 2.2,
            speed: 10.0,
            lanes: 0b1000,
        };
        let ego = EgoBody { body, taken: 0 };
        assert!(!traffic.step(road, 500.0, Some(&ego)));
        assert!(traffic.cars[0].acceleration < -1.0);
    }

    #[test]
    fn a_lane_change_is_seen_before_the_body_gets_there() {
        let road = Map::Loop.road();
        let mut traffic = Traffic::new(road, ChaCha8Rng::seed_from_u64(1), 2, 500.0, 0);
        traffic.waves = Waves::fastest_at(road, 490.0);
        for (car, (lane, s, speed)) in
            (traffic.cars.iter_mut()).zip([(3, 480.0, 14.0), (2, 498.0, 9.0)])
        {
            car.lane = lane;
            car.at = Frenet {
                s,
                d: lane_center(lane),
            };
            car.speed = speed;
            car.temper.desired_m_s = speed;
            car.until_decision_s = 1.0;
        }
        traffic.step(road, 500.0, None);
        assert!(traffic.cars[0].acceleration > -0.5);
        traffic.cars[1].lane = 3;
        traffic.step(road, 500.0, None);
        assert!(
            traffic.cars[0].acceleration < -1.0,
            "{}",
            traffic.cars[0].acceleration
        );
    }
}
