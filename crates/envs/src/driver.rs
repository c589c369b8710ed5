//! Scripted drivers: yardsticks for a learned one, and a source of varied episodes for tests.

use std::cmp::Ordering;
use std::fmt;
use std::str::FromStr;

use isodream_core::derive_seed;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::environment::{NearbyVehicle, PrivilegedView};
use crate::{EnvError, Environment};

/// Chooses actions by looking at the world itself, not at its image.
pub trait Driver: Send {
    /// The action for the present state of `env`.
    ///
    /// # Errors
    /// If `env` shows no [`PrivilegedView`] and the driver needs one.
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError>;
}

/// The scripted drivers by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScriptedDriver {
    /// [`KeepLaneDriver`].
    KeepLane,
    /// [`OvertakeDriver`].
    Overtake,
    /// [`RandomDriver`].
    Random,
}

impl ScriptedDriver {
    /// All drivers.
    pub const ALL: [Self; 3] = [Self::KeepLane, Self::Overtake, Self::Random];

    /// Stable name, as on command lines and in metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::KeepLane => "keep_lane",
            Self::Overtake => "overtake",
            Self::Random => "random",
        }
    }

    /// A fresh driver; `seed` matters to the random one only. Make one per episode.
    pub fn driver(self, seed: u64) -> Box<dyn Driver> {
        match self {
            Self::KeepLane => Box::new(KeepLaneDriver::default()),
            Self::Overtake => Box::new(OvertakeDriver::default()),
            Self::Random => Box::new(RandomDriver::new(seed)),
        }
    }
}

impl fmt::Display for ScriptedDriver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for ScriptedDriver {
    type Err = EnvError;

    fn from_str(name: &str) -> Result<Self, EnvError> {
        let found = Self::ALL.into_iter().find(|driver| driver.as_str() == name);
        found.ok_or_else(|| EnvError::UnknownDriver {
            name: name.to_owned(),
            known: Self::ALL.map(Self::as_str).join(", "),
        })
    }
}

/// Draws each component uniformly from `[-1, 1]`.
#[derive(Debug, Clone)]
pub struct RandomDriver {
    rng: ChaCha8Rng,
}

impl RandomDriver {
    /// A driver whose actions follow from `seed`.
    pub fn new(seed: u64) -> Self {
        Self {
            rng: ChaCha8Rng::seed_from_u64(derive_seed(seed, &["random-driver"])),
        }
    }
}

impl Driver for RandomDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        Ok((0..env.spec().action_dim)
            .map(|_| self.rng.random_range(-1.0..=1.0))
            .collect())
    }
}

/// Stays in the lane it starts in, behind whoever drives there.
#[derive(Debug, Clone, Default)]
pub struct KeepLaneDriver {
    lane: Option<usize>,
}

impl Driver for KeepLaneDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        let view = view(env)?;
        let lane = *self.lane.get_or_insert(view.lane);
        Ok(drive(&view, lane, 1 << lane | 1 << view.lane))
    }
}

/// Changes to the lane that lets it drive fastest, where there is a gap.
#[derive(Debug, Clone, Default)]
pub struct OvertakeDriver {
    lane: Option<usize>,
}

/// How much faster another lane must be to be worth a change.
const WORTH_A_CHANGE_M_S: f64 = 0.8;
/// What each lane on the way takes off the speed that a lane promises.
const LANE_CROSSED_M_S: f64 = 0.4;
/// Nearer than this to the chosen lane's centre the next change may begin.
const SETTLED_M: f64 = 0.8;

impl Driver for OvertakeDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        let view = view(env)?;
        let lane = *self.lane.get_or_insert(view.lane);
        let chosen = choose_lane(&view, lane);
        self.lane = Some(chosen);
        Ok(drive(&view, chosen, 1 << chosen | 1 << view.lane))
    }
}

fn choose_lane(view: &PrivilegedView, lane: usize) -> usize {
    if (view.d_m - view.lane_center_m(lane)).abs() > SETTLED_M {
        // Back out of a change whose gap has closed.
        return if lane != view.lane && !has_gap(view, lane) {
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
    if next == lane || has_gap(view, next) {
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

fn has_gap(view: &PrivilegedView, lane: usize) -> bool {
    view.vehicles
        .iter()
        .filter(|car| car.lanes & 1 << lane != 0)
        .all(|car| {
            let gap = bumper_gap(view, car);
            let closing = if car.ahead_m > 0.0 {
                view.speed_m_s - car.speed_m_s
            } else {
                car.speed_m_s - view.speed_m_s
            };
            gap > 1.5 + 0.5 * closing.max(0.0) + 0.1 * closing.max(0.0).powi(2)
        })
}

const DESIRED_M_S: f64 = 24.0;

fn view(env: &dyn Environment) -> Result<PrivilegedView, EnvError> {
    env.privileged().ok_or_else(|| EnvError::NoPrivilegedView {
        id: env.spec().id.clone(),
    })
}

/// Steers to the centre of `lane` and follows the nearest leader in `lanes`.
fn drive(view: &PrivilegedView, lane: usize, lanes: u8) -> Vec<f32> {
    vec![steer(view, lane) as f32, pedal(view, lanes) as f32]
}

fn steer(view: &PrivilegedView, lane: usize) -> f64 {
    /// Steeper headings towards a lane's centre would cost more steering than they gain.
    const GREATEST_HEADING_RAD: f64 = 0.16;
    let error = view.lane_center_m(lane) - view.d_m;
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

fn leader(view: &PrivilegedView, lanes: u8) -> Option<(f64, NearbyVehicle)> {
    view.vehicles
        .iter()
        .filter(|car| car.ahead_m > 0.0 && car.lanes & lanes != 0)
        .map(|car| (bumper_gap(view, car), *car))
        .min_by(|a, b| a.0.total_cmp(&b.0))
}

fn bumper_gap(view: &PrivilegedView, car: &NearbyVehicle) -> f64 {
    car.ahead_m.abs() - (view.length_m + car.length_m) / 2.0
}
