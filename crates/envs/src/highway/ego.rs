//! The ego: a kinematic bicycle with tyres that saturate, plus the sideways slip and spin that collisions give it.

use crate::geometry::{Vec2, wrap_angle};
use crate::highway::road::{Frenet, Road};

/// Length of a simulator frame.
pub(crate) const DT: f64 = 0.05;

pub(crate) const LENGTH: f64 = 4.4;
pub(crate) const WIDTH: f64 = 1.8;
pub(crate) const WHEELBASE: f64 = 2.6;
pub(crate) const MASS_KG: f64 = 1500.0;
pub(crate) const INERTIA_KG_M2: f64 = 2500.0;

/// Acceleration of full throttle at standstill; it falls linearly with speed.
const THROTTLE_M_S2: f64 = 5.0;
const THROTTLE_FADES_AT_M_S: f64 = 29.0;
/// Deceleration of the full brake. It grows with the square of the pedal: gentle at first, like a real one.
const BRAKE_M_S2: f64 = 6.5;
const ROLLING_M_S2: f64 = 0.1;
const AIR_DRAG_PER_M: f64 = 0.001;
/// Steer 1 at standstill; it halves at `STEER_HALVES_AT_M_S`.
const STEER_RAD: f64 = 0.6;
const STEER_HALVES_AT_M_S: f64 = 12.0;
/// Time constant of the steering gear.
const STEER_LAG_S: f64 = 0.1;
/// What the tyres can hold sideways, both in a bend and against a slide.
const GRIP_M_S2: f64 = 7.5;
const SPIN_LAG_S: f64 = 0.2;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Ego {
    pub(crate) position: Vec2,
    pub(crate) yaw: f64,
    /// Forward speed; negative only while it rolls back after a collision.
    pub(crate) speed: f64,
    /// Sideways speed to the left, from collisions.
    pub(crate) slip: f64,
    /// Yaw rate on top of that of the steering, from collisions.
    pub(crate) spin: f64,
    /// Position of the front wheels in `[-1, 1]`, positive to the right.
    pub(crate) steer: f64,
    pub(crate) at: Frenet,
    pub(crate) braking: bool,
}

/// What steer 1 commands at `speed`.
pub(crate) fn max_steer_rad(speed: f64) -> f64 {
    STEER_RAD / (1.0 + speed.abs() / STEER_HALVES_AT_M_S)
}

impl Ego {
    /// At rest in road coordinates, along the road.
    pub(crate) fn at_rest(road: &Road, at: Frenet) -> Self {
        Self {
            position: road.to_world(at),
            yaw: road.heading(at.s),
            speed: 0.0,
            slip: 0.0,
            spin: 0.0,
            steer: 0.0,
            at,
            braking: false,
        }
    }

    pub(crate) fn forward(&self) -> Vec2 {
        Vec2::from_angle(self.yaw)
    }

    pub(crate) fn velocity(&self) -> Vec2 {
        let forward = self.forward();
        forward * self.speed + forward.left() * self.slip
    }

    /// Replaces the velocity, as a collision does.
    pub(crate) fn set_velocity(&mut self, velocity: Vec2) {
        let forward = self.forward();
        self.speed = velocity.dot(forward);
        self.slip = velocity.dot(forward.left());
    }

    pub(crate) fn heading_error(&self, road: &Road) -> f64 {
        wrap_angle(self.yaw - road.heading(self.at.s))
    }

    /// Half the extent along and across the road.
    pub(crate) fn half_extents(&self, road: &Road) -> (f64, f64) {
        let (sin, cos) = self.heading_error(road).sin_cos();
        let (length, width) = (LENGTH / 2.0, WIDTH / 2.0);
        (
            length * cos.abs() + width * sin.abs(),
            length * sin.abs() + width * cos.abs(),
        )
    }

    /// One frame. `steer` is positive to the right; `pedal` is throttle if positive, else brake.
    pub(crate) fn advance(&mut self, road: &Road, steer: f64, pedal: f64) {
        self.steer += (steer - self.steer) * (DT / STEER_LAG_S).min(1.0);
        self.accelerate(pedal);

        let wheel_rad = -self.steer * max_steer_rad(self.speed);
        let grip_curvature = GRIP_M_S2 / (self.speed * self.speed).max(0.1);
        let curvature = (wheel_rad.tan() / WHEELBASE).clamp(-grip_curvature, grip_curvature);
        let yaw_rate = self.speed * curvature;

        let forward = self.forward();
        // The body turns about its rear axle, so its centre also moves sideways.
        let sideways = self.slip + yaw_rate * WHEELBASE / 2.0;
        self.position = self.position + (forward * self.speed + forward.left() * sideways) * DT;

        // A spin turns the body under its velocity; the steering turns the velocity with the body.
        let velocity = self.velocity();
        self.yaw = wrap_angle(self.yaw + self.spin * DT);
        self.set_velocity(velocity);
        self.yaw = wrap_angle(self.yaw + yaw_rate * DT);

        self.slip -= self.slip.clamp(-GRIP_M_S2 * DT, GRIP_M_S2 * DT);
        self.spin *= (-DT / SPIN_LAG_S).exp();
        self.locate(road);
    }

    fn accelerate(&mut self, pedal: f64) {
        self.braking = pedal < 0.0;
        let throttle = pedal.max(0.0)
            * THROTTLE_M_S2
            * (1.0 - self.speed / THROTTLE_FADES_AT_M_S).clamp(0.0, 1.0);
        let resistance = pedal.min(0.0).powi(2) * BRAKE_M_S2
            + ROLLING_M_S2
            + AIR_DRAG_PER_M * self.speed * self.speed;
        self.speed += throttle * DT;
        // Resistance stops a car but never reverses it.
        self.speed -= self.speed.clamp(-resistance * DT, resistance * DT);
    }

    /// Brings the road coordinates up to date with the position.
    pub(crate) fn locate(&mut self, road: &Road) {
        self.at = road.project(self.position, self.at.s);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::highway::maps::Map;

    fn start() -> Ego {
        Ego::at_rest(Map::Loop.road(), Frenet { s: 100.0, d: 1.75 })
    }

    fn drive(ego: &mut Ego, frames: usize, steer: f64, pedal: f64) {
        for _ in 0..frames {
            ego.advance(Map::Loop.road(), steer, pedal);
        }
    }

    #[test]
    fn full_throttle_reaches_about_25_m_s() {
        let mut ego = start();
        ego.advance(Map::Loop.road(), 0.0, 1.0);
        assert!((ego.speed / DT - THROTTLE_M_S2).abs() < 0.2);
        drive(&mut ego, 1_200, 0.0, 1.0);
        assert!((23.0..27.0).contains(&ego.speed), "{}", ego.speed);
    }

    #[test]
    fn the_brake_stops_and_never_reverses() {
        let mut ego = start();
        drive(&mut ego, 60, 0.0, 1.0);
        drive(&mut ego, 200, 0.0, -1.0);
        assert_eq!(ego.speed, 0.0);
    }

    #[test]
    fn positive_steer_turns_right() {
        let mut ego = start();
        let before = ego.yaw;
        drive(&mut ego, 20, 0.3, 1.0);
        assert!(wrap_angle(ego.yaw - before) < -0.01);
    }

    #[test]
    fn the_tyres_limit_the_turn_at_speed() {
        let mut ego = start();
        ego.speed = 20.0;
        drive(&mut ego, 10, 1.0, 0.0);
        let before = ego.yaw;
        ego.advance(Map::Loop.road(), 1.0, 0.0);
        let lateral = wrap_angle(ego.yaw - before).abs() / DT * ego.speed;
        assert!((lateral - GRIP_M_S2).abs() < 0.2, "{lateral}");
    }

    #[test]
    fn a_slide_comes_to_rest() {
        let mut ego = start();
        ego.slip = 4.0;
        ego.spin = 2.0;
        drive(&mut ego, 60, 0.0, -1.0);
        assert!(ego.slip.abs() < 1e-9 && ego.spin.abs() < 1e-3);
    }
}
