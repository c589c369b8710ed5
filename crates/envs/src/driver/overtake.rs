//! Drivers that change to the lane which promises most: one waits for a gap, the other makes one.

use std::cmp::Ordering;

use super::Driver;
use super::controls::{DESIRED_M_S, bumper_gap, drive, drive_at, leader, view};
use crate::environment::{NearbyVehicle, PrivilegedView};
use crate::{EnvError, Environment};

/// Changes to the lane that lets it drive fastest, where there is a gap.
#[derive(Debug, Clone, Default)]
pub struct OvertakeDriver {
    lane: Option<usize>,
}

impl Driver for OvertakeDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        let view = view(env)?;
        let chosen = choose_lane(&view, self.lane.unwrap_or(view.lane), waits_for);
        self.lane = Some(chosen);
        Ok(drive(&view, chosen, 1 << chosen | 1 << view.lane))
    }
}

/// Changes to the lane that lets it drive fastest and makes its own gap: it pushes its nose over the line, trusts that
/// whoever comes along will brake, and goes as soon as there is room for its body.
#[derive(Debug, Clone, Default)]
pub struct CutInDriver {
    lane: Option<usize>,
}

/// How far the nose goes over before there is room: enough to take up the lane, too little to touch a car in it.
const NOSE_M: f64 = 1.2;

impl CutInDriver {
    /// The action for what `view` shows.
    pub(crate) fn decide(&mut self, view: &PrivilegedView) -> Vec<f32> {
        let chosen = choose_lane(view, self.lane.unwrap_or(view.lane), |_, _| true);
        self.lane = Some(chosen);
        if chosen == view.lane || has_gap(view, chosen, fits_before) {
            return drive(view, chosen, 1 << chosen | 1 << view.lane);
        }
        let here = view.lane_center_m(view.lane);
        let nose = here + NOSE_M * (view.lane_center_m(chosen) - here).signum();
        drive_at(view, nose, 1 << view.lane)
    }
}

impl Driver for CutInDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        Ok(self.decide(&view(env)?))
    }
}

/// Whether there is room enough between the ego and another car.
type Room = fn(&PrivilegedView, &NearbyVehicle) -> bool;

/// How much faster another lane must be to be worth a change.
const WORTH_A_CHANGE_M_S: f64 = 0.8;
/// What each lane on the way takes off the speed that a lane promises.
const LANE_CROSSED_M_S: f64 = 0.4;
/// Nearer than this to the chosen lane's centre the next change may begin.
const SETTLED_M: f64 = 0.8;

fn choose_lane(view: &PrivilegedView, lane: usize, room: Room) -> usize {
    if (view.d_m - view.lane_center_m(lane)).abs() > SETTLED_M {
        // Back out of a change whose gap has closed.
        return if lane != view.lane && !has_gap(view, lane, room) {
            view.lane
        } else {
            lane
        };
    }
    let score = |candidate: usize| {
        promised_speed(view, candidate) - LANE_CROSSED_M_S * candidate.abs_diff(lane) as f64
    };
    let best = (0..view.lanes).fold(lane, |best, candidate| {
        let needed = if best == lane {
            WORTH_A_CHANGE_M_S
        } else {
            0.0
        };
        if score(candidate) > score(best) + needed {
            candidate
        } else {
            best
        }
    });
    // One lane at a time, also where the way leads through a slower one.
    let next = match best.cmp(&lane) {
        Ordering::Less => lane - 1,
        Ordering::Equal => lane,
        Ordering::Greater => lane + 1,
    };
    if next == lane || has_gap(view, next, room) {
        next
    } else {
        lane
    }
}

/// Mean speed over the next seconds in `lane`: the leader's, plus what its gap leaves to close.
fn promised_speed(view: &PrivilegedView, lane: usize) -> f64 {
    const HORIZON_S: f64 = 12.0;
    match leader(view, 1 << lane) {
        Some((gap, car)) => (car.speed_m_s + (gap - 5.0).max(0.0) / HORIZON_S).min(DESIRED_M_S),
        None => DESIRED_M_S,
    }
}

fn has_gap(view: &PrivilegedView, lane: usize, room: Room) -> bool {
    view.vehicles
        .iter()
        .filter(|car| car.lanes & 1 << lane != 0)
        .all(|car| room(view, car))
}

/// Room in which nobody has to brake hard.
fn waits_for(view: &PrivilegedView, car: &NearbyVehicle) -> bool {
    let closing = closing_speed(view, car).max(0.0);
    bumper_gap(view, car) > 1.5 + 0.5 * closing + 0.1 * closing.powi(2)
}

/// Room for the body, where those behind brake as hard as they can.
fn fits_before(view: &PrivilegedView, car: &NearbyVehicle) -> bool {
    const BRAKE_M_S2: f64 = 8.0;
    let closing = closing_speed(view, car).max(0.0);
    bumper_gap(view, car) > 0.8 + closing.powi(2) / (2.0 * BRAKE_M_S2)
}

/// How fast the gap to `car` shrinks.
fn closing_speed(view: &PrivilegedView, car: &NearbyVehicle) -> f64 {
    if car.ahead_m > 0.0 {
        view.speed_m_s - car.speed_m_s
    } else {
        car.speed_m_s - view.speed_m_s
    }
}
