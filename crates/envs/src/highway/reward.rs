//! The reward of one simulator frame, with the weights of the Iso-Dream++ paper.

use crate::geometry::Vec2;
use crate::highway::ego::{DT, Ego};
use crate::highway::road::Road;

/// Reward per N s of collision impulse (the paper's xi_1).
const IMPULSE_WEIGHT: f64 = 1e-4;
/// Reward per unit of steering (the paper's xi_2).
const STEER_WEIGHT: f64 = 1.0;
/// The lane's direction is that of this point ahead of the ego.
const LOOK_AHEAD_M: f64 = 5.0;

/// `v . u * dt - 1e-4 * impulse - |steer|`, where `u` is the lane's direction ahead.
pub(crate) fn frame_reward(
    velocity: Vec2,
    lane_direction: Vec2,
    impulse_ns: f64,
    steer: f64,
) -> f64 {
    velocity.dot(lane_direction) * DT - IMPULSE_WEIGHT * impulse_ns - STEER_WEIGHT * steer.abs()
}

/// The direction of the lane that the reward projects the ego's velocity on.
pub(crate) fn lane_direction(road: &Road, ego: &Ego) -> Vec2 {
    road.tangent(ego.at.s + LOOK_AHEAD_M)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::highway::maps::Map;

    #[test]
    fn matches_the_formula_by_hand() {
        // 20 m/s at 60 degrees to the lane: 10 m/s along it; 10 * .05 - 1e-4 * 3000 - .25 = -.05.
        let velocity = Vec2::from_angle(60.0_f64.to_radians()) * 20.0;
        let reward = frame_reward(velocity, Vec2::new(1.0, 0.0), 3_000.0, -0.25);
        assert!((reward + 0.05).abs() < 1e-12, "{reward}");
    }

    #[test]
    fn the_direction_is_that_of_the_road_five_metres_ahead() {
        let road = Map::Loop.road();
        let ego = Ego::at_rest(road, crate::highway::road::Frenet { s: 40.0, d: 1.0 });
        let expected = road.tangent(45.0);
        assert!((lane_direction(road, &ego) - expected).norm() < 1e-6);
    }
}
