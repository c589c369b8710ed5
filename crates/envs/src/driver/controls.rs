//! Steering and pedals for those who look at the world itself, in road coordinates.

use crate::environment::{NearbyVehicle, PrivilegedView};
use crate::{EnvError, Environment};

pub(super) const DESIRED_M_S: f64 = 24.0;

/// How a driver follows the car ahead.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Following {
    /// Gap kept at standstill.
    pub(super) gap_m: f64,
    /// Time gap kept while driving.
    pub(super) headway_s: f64,
    /// Speed on an empty road.
    pub(super) desired_m_s: f64,
}

impl Following {
    pub(super) const NORMAL: Self = Self {
        gap_m: 3.0,
        headway_s: 0.5,
        desired_m_s: DESIRED_M_S,
    };
}

pub(super) fn view(env: &dyn Environment) -> Result<PrivilegedView, EnvError> {
    env.privileged().ok_or_else(|| EnvError::NoPrivilegedView {
        id: env.spec().id.clone(),
    })
}

/// Steers to the centre of `lane` and follows the nearest leader in it and in the lane that the ego is in.
pub(super) fn drive(view: &PrivilegedView, lane: usize, following: Following) -> Vec<f32> {
    let lanes = 1 << lane | 1 << view.lane;
    drive_at(view, view.lane_center_m(lane), lanes, following)
}

/// Steers to the lateral position `d_m` and follows the nearest leader in `lanes`.
pub(super) fn drive_at(
    view: &PrivilegedView,
    d_m: f64,
    lanes: u8,
    following: Following,
) -> Vec<f32> {
    let steer = steer(view, d_m);
    vec![steer as f32, pedal(view, lanes, following) as f32]
}

/// Steer that brings the ego to the lateral position `d_m`.
pub(super) fn steer(view: &PrivilegedView, d_m: f64) -> f64 {
    /// Steeper headings towards a lane's centre would cost more steering than they gain.
    const GREATEST_HEADING_RAD: f64 = 0.16;
    let error = d_m - view.d_m;
    let speed = view.speed_m_s.max(3.0);
    let wanted_heading = (error / (1.8 * speed)).clamp(-GREATEST_HEADING_RAD, GREATEST_HEADING_RAD);
    let turn_per_s = (wanted_heading - view.heading_error_rad) / 0.6;
    let curvature = view.curvature_per_m + turn_per_s / speed;
    let wheel_rad = (curvature * view.wheelbase_m).atan();
    (-wheel_rad / view.max_steer_rad).clamp(-1.0, 1.0)
}

fn pedal(view: &PrivilegedView, lanes: u8, following: Following) -> f64 {
    let speed = view.speed_m_s;
    let free = 1.0 - (speed / following.desired_m_s).powi(4);
    let Some((gap, car)) = leader(view, lanes) else {
        return free.clamp(-1.0, 1.0);
    };
    let closing = speed - car.speed_m_s;
    let needed = closing.max(0.0).powi(2) / (2.0 * (gap - 1.5).max(0.1));
    if needed > 3.5 || gap < 1.0 && speed > 0.5 {
        return -1.0;
    }
    let dynamic = speed * following.headway_s + speed * closing / 7.0;
    let wanted = following.gap_m + dynamic.max(0.0);
    (free - (wanted / gap.max(0.1)).powi(2)).clamp(-1.0, 1.0)
}

pub(super) fn leader(view: &PrivilegedView, lanes: u8) -> Option<(f64, NearbyVehicle)> {
    view.vehicles
        .iter()
        .filter(|car| car.ahead_m > 0.0 && car.lanes & lanes != 0)
        .map(|car| (bumper_gap(view, car), *car))
        .min_by(|a, b| a.0.total_cmp(&b.0))
}

pub(super) fn bumper_gap(view: &PrivilegedView, car: &NearbyVehicle) -> f64 {
    car.ahead_m.abs() - (view.length_m + car.length_m) / 2.0
}
