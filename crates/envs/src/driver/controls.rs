//! Steering and pedals for those who look at the world itself, in road coordinates.

use crate::environment::{NearbyVehicle, PrivilegedView};
use crate::{EnvError, Environment};

pub(super) const DESIRED_M_S: f64 = 24.0;

pub(super) fn view(env: &dyn Environment) -> Result<PrivilegedView, EnvError> {
    env.privileged().ok_or_else(|| EnvError::NoPrivilegedView {
        id: env.spec().id.clone(),
    })
}

/// Steers to the centre of `lane` and follows the nearest leader in `lanes`.
pub(super) fn drive(view: &PrivilegedView, lane: usize, lanes: u8) -> Vec<f32> {
    drive_at(view, view.lane_center_m(lane), lanes)
}

/// As [`drive`], to the lateral position `d_m`.
pub(super) fn drive_at(view: &PrivilegedView, d_m: f64, lanes: u8) -> Vec<f32> {
    vec![steer(view, d_m) as f32, pedal(view, lanes) as f32]
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

fn pedal(view: &PrivilegedView, lanes: u8) -> f64 {
    const GAP_M: f64 = 3.0;
    const HEADWAY_S: f64 = 0.5;
    let speed = view.speed_m_s;
    let free = 1.0 - (speed / DESIRED_M_S).powi(4);
    let Some((gap, car)) = leader(view, lanes) else {
        return free.clamp(-1.0, 1.0);
    };
    let closing = speed - car.speed_m_s;
    let needed = closing.max(0.0).powi(2) / (2.0 * (gap - 1.5).max(0.1));
    if needed > 3.5 || gap < 1.0 && speed > 0.5 {
        return -1.0;
    }
    let wanted = GAP_M + (speed * HEADWAY_S + speed * closing / 7.0).max(0.0);
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
