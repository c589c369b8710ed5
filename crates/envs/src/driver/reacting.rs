//! A driver that changes to the lane which promises most at present.

use std::cmp::Ordering;

use super::Driver;
use super::controls::{DESIRED_M_S, Following, bumper_gap, drive, drive_at, leader, view};
use crate::environment::{NearbyVehicle, PrivilegedView};
use crate::{EnvError, Environment};

/// Changes to the lane that lets it drive fastest, where there is a gap. It sees where everyone is and how fast, and
/// nothing of what they will do.
#[derive(Debug, Clone, Default)]
pub struct ReactingDriver {
    lane: Option<usize>,
}

impl ReactingDriver {
    /// The action for what `view` shows.
    pub(super) fn decide(&mut self, view: &PrivilegedView) -> Vec<f32> {
        let chosen = choose_lane(view, self.lane.unwrap_or(view.lane));
        self.lane = Some(chosen);
        if chosen == view.lane || has_gap(view, chosen) {
            return drive(view, chosen, FOLLOWING);
        }
        let here = view.lane_center_m(view.lane);
        let nose = here + NOSE_M * (view.lane_center_m(chosen) - here).signum();
        drive_at(view, nose, 1 << view.lane, FOLLOWING)
    }
}

impl Driver for ReactingDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        Ok(self.decide(&view(env)?))
    }
}

/// Close, as it pays to lose no time.
const FOLLOWING: Following = Following {
    gap_m: 2.2,
    headway_s: 0.25,
    ..Following::NORMAL
};
/// Below this speed it makes its own gap: it pushes its nose over the line, and whoever comes along brakes.
const PATIENT_FROM_M_S: f64 = 10.0;
/// What a lane promises more than the one to its right, beyond what the cars in sight show.
const FASTER_PER_LANE_M_S: f64 = 1.0;
/// How far the nose goes over the line before there is room: enough to take up the lane, too little to touch a car in it.
const NOSE_M: f64 = 1.2;

/// How much faster another lane must be to be worth a change.
const WORTH_A_CHANGE_M_S: f64 = 0.8;
/// What each lane on the way takes off the speed that a lane promises.
const LANE_CROSSED_M_S: f64 = 0.4;
/// Nearer than this to the chosen lane's centre the next change may begin.
const SETTLED_M: f64 = 0.8;

fn choose_lane(view: &PrivilegedView, lane: usize) -> usize {
    if (view.d_m - view.lane_center_m(lane)).abs() > SETTLED_M {
        return lane;
    }
    let score = |candidate: usize| {
        promised_speed(view, candidate) + FASTER_PER_LANE_M_S * candidate as f64
            - LANE_CROSSED_M_S * candidate.abs_diff(lane) as f64
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
    let patient = view.speed_m_s > PATIENT_FROM_M_S;
    if patient && next != lane && !has_gap(view, next) {
        lane
    } else {
        next
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

fn has_gap(view: &PrivilegedView, lane: usize) -> bool {
    view.vehicles
        .iter()
        .filter(|car| car.lanes & 1 << lane != 0)
        .all(|car| has_room(view, car))
}

/// Room in which nobody has to brake hard.
fn has_room(view: &PrivilegedView, car: &NearbyVehicle) -> bool {
    const BRAKE_M_S2: f64 = 7.0;
    let closing = closing_speed(view, car).max(0.0);
    bumper_gap(view, car) > 1.5 + 0.3 * closing + closing.powi(2) / (2.0 * BRAKE_M_S2)
}

/// How fast the gap to `car` shrinks.
fn closing_speed(view: &PrivilegedView, car: &NearbyVehicle) -> f64 {
    if car.ahead_m > 0.0 {
        view.speed_m_s - car.speed_m_s
    } else {
        car.speed_m_s - view.speed_m_s
    }
}
