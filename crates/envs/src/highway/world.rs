//! One episode's world: road, ego and traffic, advanced frame by frame.

use isodream_core::derive_seed;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::environment::{EndReason, NearbyVehicle, PrivilegedView};
use crate::highway::car::Body;
use crate::highway::collision::{self, Impulses};
use crate::highway::ego::{self, DT, Ego, LENGTH, WHEELBASE};
use crate::highway::metrics::Metrics;
use crate::highway::reward::{frame_reward, lane_direction};
use crate::highway::road::{
    BARRIER_D, Frenet, LANE_WIDTH, LANES, Road, lane_at, lane_center, lanes_overlapped,
};
use crate::highway::scene::Scene;
use crate::highway::traffic::{EgoBody, TAKEN_S, Traffic};
use crate::highway::weather::Weather;

/// Every so many frames the ego must be moving.
const STUCK_CHECK_FRAMES: u32 = 100;
const STUCK_M_S: f64 = 0.02;

/// What one frame brought.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Frame {
    pub(crate) reward: f64,
    pub(crate) interaction: bool,
    pub(crate) end: Option<EndReason>,
}

/// What an action brought that was repeated for several frames.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Repeated {
    /// The sum over the frames.
    pub(crate) reward: f64,
    pub(crate) frames: u32,
    pub(crate) interaction: bool,
    pub(crate) end: Option<EndReason>,
}

#[derive(Debug, Clone)]
pub(crate) struct World {
    pub(crate) road: &'static Road,
    pub(crate) ego: Ego,
    pub(crate) traffic: Traffic,
    pub(crate) metrics: Metrics,
    /// `None` where it stays fine.
    pub(crate) weather: Option<Weather>,
    frames: u32,
    /// For how long the ego has been in each lane without a break; 0 where it is not.
    in_lane_s: [f64; LANES],
}

impl World {
    pub(crate) fn new(scene: Scene, seed: u64, vehicles: u32) -> Self {
        let road = scene.map.road();
        let mut rng = stream(seed, "ego");
        let lane = rng.random_range(0..LANES);
        let s = rng.random_range(road.starts());
        let ego = Ego::at_rest(
            road,
            Frenet {
                s,
                d: lane_center(lane),
            },
        );
        let mut in_lane_s = [0.0; LANES];
        // The ego did not take the lane it starts in from anyone.
        in_lane_s[lane] = f64::INFINITY;
        let (traffic_rng, vehicles) = (stream(seed, "traffic"), vehicles as usize);
        Self {
            road,
            traffic: Traffic::new(road, traffic_rng, vehicles, s, lane),
            metrics: Metrics::new(lane),
            weather: None,
            ego,
            frames: 0,
            in_lane_s,
        }
    }

    /// Gives the episode weather that drifts, from a stream of its own: nothing else changes.
    pub(crate) fn let_weather_drift(&mut self, seed: u64) {
        self.weather = Some(Weather::random(&mut stream(seed, "weather")));
    }

    /// As [`Self::step`] for `frames` frames, fewer where the episode ends.
    pub(crate) fn repeat(&mut self, steer: f64, pedal: f64, frames: u32) -> Repeated {
        let mut repeated = Repeated::default();
        while repeated.frames < frames && repeated.end.is_none() {
            let frame = self.step(steer, pedal);
            repeated.reward += frame.reward;
            repeated.frames += 1;
            repeated.interaction |= frame.interaction;
            repeated.end = frame.end;
        }
        repeated
    }

    /// One frame of [`DT`]. `steer` is positive to the right; `pedal` is throttle if positive, else brake.
    pub(crate) fn step(&mut self, steer: f64, pedal: f64) -> Frame {
        self.frames += 1;
        if let Some(weather) = &mut self.weather {
            weather.step();
        }
        let before = self.ego.at;
        self.ego.advance(self.road, steer, pedal);
        let body = self.ego_body();
        self.meet_traffic(before, steer, Some(&body))
    }

    /// The rest of a frame, after the ego moved on from `before`. Nobody brakes for an ego of `None`.
    fn meet_traffic(&mut self, before: Frenet, steer: f64, ego: Option<&EgoBody>) -> Frame {
        let interaction = self.traffic.step(self.road, self.ego.at.s, ego);
        let impulses = collision::resolve_ego(self.road, &mut self.ego, &mut self.traffic.cars);
        self.record(before, impulses);
        let reward = frame_reward(
            self.ego.velocity(),
            lane_direction(self.road, &self.ego),
            impulses.vehicles + impulses.barriers,
            steer,
        );
        Frame {
            reward,
            interaction: interaction || impulses.vehicles > 0.0,
            end: self.end(),
        }
    }

    fn ego_body(&mut self) -> EgoBody {
        let (half_length, half_width) = self.ego.half_extents(self.road);
        let lanes = lanes_overlapped(self.ego.at.d, half_width);
        let mut taken = 0;
        for (lane, seconds) in self.in_lane_s.iter_mut().enumerate() {
            let is_in = lanes & 1 << lane != 0;
            *seconds = if is_in { *seconds + DT } else { 0.0 };
            if is_in && *seconds <= TAKEN_S {
                taken |= 1 << lane;
            }
        }
        let along = self.ego.velocity().dot(self.road.tangent(self.ego.at.s));
        EgoBody {
            body: Body {
                s: self.ego.at.s,
                half_length,
                speed: along.max(0.0),
                lanes,
            },
            taken,
        }
    }

    fn record(&mut self, before: Frenet, impulses: Impulses) {
        let distance = self.road.ahead(before.s, self.ego.at.s);
        self.metrics
            .frame(distance, lane_at(self.ego.at.d), impulses);
    }

    fn end(&self) -> Option<EndReason> {
        if self.ego.at.d.abs() > BARRIER_D {
            return Some(EndReason::OffRoad);
        }
        let stands = self.ego.velocity().norm() < STUCK_M_S;
        (self.frames.is_multiple_of(STUCK_CHECK_FRAMES) && stands).then_some(EndReason::Stuck)
    }

    pub(crate) fn privileged(&self) -> PrivilegedView {
        let at = self.ego.at;
        PrivilegedView {
            speed_m_s: self.ego.speed,
            d_m: at.d,
            heading_error_rad: self.ego.heading_error(self.road),
            curvature_per_m: self.road.curvature(at.s),
            lane: lane_at(at.d),
            lanes: LANES,
            lane_width_m: LANE_WIDTH,
            length_m: LENGTH,
            max_steer_rad: ego::max_steer_rad(self.ego.speed),
            wheelbase_m: WHEELBASE,
            vehicles: self
                .traffic
                .cars
                .iter()
                .map(|car| NearbyVehicle {
                    ahead_m: self.road.ahead(at.s, car.at.s),
                    d_m: car.at.d,
                    speed_m_s: car.speed,
                    length_m: 2.0 * car.half_length(),
                    lanes: car.body().lanes,
                })
                .collect(),
        }
    }
}

/// The random numbers that `seed` gives to one part of the world.
fn stream(seed: u64, part: &str) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(derive_seed(seed, &["highway", part]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::highway::maps::Map;
    use crate::render::Light;

    const LOOP: Scene = Scene::new(Map::Loop, Light::Day);

    /// The ego in lane 1 at a speed, and one car in `lane`, some metres ahead of it, at its own speed.
    fn with_one_car(ego_m_s: f64, lane: usize, ahead_m: f64, car_m_s: f64) -> World {
        let mut world = World::new(LOOP, 1, 1);
        let (s, d) = (300.0, lane_center(1));
        world.ego = Ego::at_rest(world.road, Frenet { s, d });
        world.ego.speed = ego_m_s;
        let car = &mut world.traffic.cars[0];
        car.lane = lane;
        car.at = Frenet {
            s: s + ahead_m,
            d: lane_center(lane),
        };
        car.speed = car_m_s;
        world
    }

    #[test]
    fn cutting_in_makes_an_interaction_and_slows_the_follower() {
        let mut world = with_one_car(10.0, 2, -16.0, 13.0);
        world.traffic.cars[0].temper.desired_m_s = 13.0;
        let mut speeds = Vec::new();
        let mut cut_in_at = None;
        let mut interaction_at = None;
        for tick in 0..60 {
            let frame = world.step(-0.15, 0.1);
            speeds.push(world.traffic.cars[0].speed);
            if cut_in_at.is_none() && world.ego_body().body.lanes & 0b0100 != 0 {
                cut_in_at = Some(tick);
            }
            if interaction_at.is_none() && frame.interaction {
                interaction_at = Some(tick);
            }
        }
        let (cut_in, interaction) = (cut_in_at.unwrap(), interaction_at.unwrap());
        assert!(
            (cut_in..=cut_in + 3).contains(&interaction),
            "{cut_in} {interaction}"
        );
        let within_a_second = speeds[cut_in + 20];
        assert!(
            within_a_second < speeds[cut_in] - 1.0,
            "{} to {within_a_second}",
            speeds[cut_in]
        );
    }

    #[test]
    fn hitting_a_car_is_an_interaction() {
        let mut world = with_one_car(15.0, 1, 10.0, 2.0);
        for _ in 0..40 {
            let frame = world.step(0.0, 0.5);
            let hit = world.metrics.named().contains(&("collisions", 1.0));
            assert_eq!(frame.interaction, hit, "so far nobody has touched another");
            if hit {
                return;
            }
        }
        panic!("the ego never reached the car");
    }

    #[test]
    fn leaving_the_road_ends_the_episode() {
        let mut world = World::new(LOOP, 1, 0);
        world.ego = Ego::at_rest(
            world.road,
            Frenet {
                s: 50.0,
                d: BARRIER_D + 0.5,
            },
        );
        assert_eq!(world.step(0.0, 0.0).end, Some(EndReason::OffRoad));
    }

    #[test]
    fn standing_ends_the_episode_at_the_check_and_not_before() {
        let mut world = World::new(LOOP, 1, 0);
        for frame in 1..100 {
            assert_eq!(world.step(0.0, -1.0).end, None, "frame {frame}");
        }
        assert_eq!(world.step(0.0, -1.0).end, Some(EndReason::Stuck));
    }

    #[test]
    fn rewards_forward_speed_by_hand() {
        let mut world = World::new(LOOP, 1, 0);
        world.ego.speed = 20.0;
        let reward = world.step(0.0, 0.0).reward;
        assert!((reward - 1.0).abs() < 0.01, "{reward}");
    }

    #[test]
    fn the_ego_takes_up_every_lane_that_its_body_overlaps() {
        let mut world = World::new(LOOP, 1, 0);
        let d = lane_center(1) + 1.2;
        world.ego = Ego::at_rest(world.road, Frenet { s: 50.0, d });
        let body = world.ego_body();
        assert_eq!(body.body.lanes, 0b0110);
        assert_eq!(body.taken & 0b0100, 0b0100);
    }

    #[test]
    fn a_collision_costs_its_impulse() {
        let mut world = World::new(LOOP, 1, 1);
        let road = world.road;
        world.ego = Ego::at_rest(
            road,
            Frenet {
                s: 300.0,
                d: lane_center(1),
            },
        );
        world.ego.speed = 15.0;
        let car = &mut world.traffic.cars[0];
        car.at = Frenet {
            s: 300.0 + 5.0,
            d: lane_center(1),
        };
        car.lane = 1;
        let reward = world.step(0.0, 0.0).reward;
        let named = world.metrics.named();
        let impulse = named
            .iter()
            .find(|(name, _)| *name == "impulse_ns")
            .unwrap();
        assert!(impulse.1 > 5_000.0, "{impulse:?}");
        let driving = world.ego.velocity().dot(lane_direction(road, &world.ego)) * DT;
        assert!((reward - (driving - 1e-4 * impulse.1)).abs() < 1e-9);
        assert!(world.metrics.named().contains(&("collisions", 1.0)));
    }
}
