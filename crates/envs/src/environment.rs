//! The contract between agents and worlds.

use std::fmt;

use isodream_core::EnvSpec;

use crate::EnvError;

/// Classes of [`Environment::segmentation`].
pub mod class {
    /// Sky, mountains, terrain and everything that stands on it.
    pub const BACKGROUND: u8 = 0;
    /// The road: surface, lines and barriers; or the floor.
    pub const ROAD: u8 = 1;
    /// A vehicle other than the ego.
    pub const VEHICLE: u8 = 2;
    /// What the agent moves, where it sees itself.
    pub const AGENT: u8 = 3;
}

/// A world that takes actions and shows images.
///
/// The same seed followed by the same actions gives the same bytes.
pub trait Environment: Send {
    /// What the environment shows and takes.
    fn spec(&self) -> &EnvSpec;

    /// Starts a new episode; the transition is row 0: reward 0, discount 1.
    ///
    /// # Errors
    /// If the world cannot start.
    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError>;

    /// Repeats `action` for `action_repeat` simulator frames. Components outside `[-1, 1]` are clamped.
    ///
    /// # Errors
    /// If the action has the wrong dimension or is not finite, or if no episode is running.
    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError>;

    /// The [`class`] of each pixel `[H, W]` of the newest observation, or `None` where the world does not know.
    fn segmentation(&self) -> Option<Vec<u8>>;

    /// Named measurements of the episode so far.
    fn metrics(&self) -> Vec<(&'static str, f64)>;

    /// What scripted drivers may see and agents may not.
    fn privileged(&self) -> Option<PrivilegedView>;

    /// A copy of the world in its present state, for drivers that try out the future. `None` where there is none.
    fn simulator(&self) -> Option<Box<dyn Simulator>> {
        None
    }
}

/// A copy of a world that runs on without pictures. Its random numbers are those of the world it is a copy of: the same
/// actions lead to the same future.
pub trait Simulator: Send {
    /// A copy of the present state.
    fn fork(&self) -> Box<dyn Simulator>;

    /// What scripted drivers see.
    fn privileged(&self) -> PrivilegedView;

    /// As [`Environment::step`], for actions that are known to be valid. At the end of an episode it stays as it is.
    fn step(&mut self, action: &[f32]) -> Outlook;
}

/// What one [`Simulator::step`] returns.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outlook {
    /// Reward received on arriving here.
    pub reward: f64,
    /// Whether the episode ends here.
    pub is_last: bool,
}

/// What one [`Environment::reset`] or [`Environment::step`] returns.
#[derive(Debug, Clone, PartialEq)]
pub struct Transition {
    /// Observation: `[H, W, C]` bytes.
    pub image: Vec<u8>,
    /// Reward received on arriving here.
    pub reward: f32,
    /// 0 where the episode really ended, else 1 (also at a time limit).
    pub discount: f32,
    /// Whether the episode ends here.
    pub is_last: bool,
    /// Whether it ended for a reason inside the world, not for the time limit.
    pub is_terminal: bool,
    /// Ground truth of the dependency gate: another vehicle moved otherwise on account of the ego, which took its lane and
    /// made it brake, or hit it.
    pub interaction: bool,
    /// Why the episode ended.
    pub end_reason: Option<EndReason>,
}

impl Transition {
    /// Row 0 of an episode.
    pub fn first(image: Vec<u8>) -> Self {
        Self {
            image,
            reward: 0.0,
            discount: 1.0,
            is_last: false,
            is_terminal: false,
            interaction: false,
            end_reason: None,
        }
    }
}

/// Why an episode ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum EndReason {
    /// The ego's centre is beyond the barriers.
    OffRoad,
    /// The ego stood still at one of the regular checks.
    Stuck,
    /// The agent steps are used up; not terminal.
    TimeLimit,
    /// A world of another process ended the episode, for a reason that has no name here.
    Ended,
}

impl EndReason {
    const ALL: [Self; 4] = [Self::OffRoad, Self::Stuck, Self::TimeLimit, Self::Ended];

    /// The reason of this name; for a name that nobody here knows, the nearest one that agrees with
    /// `is_terminal`.
    pub fn named(name: &str, is_terminal: bool) -> Self {
        let mut known = Self::ALL
            .into_iter()
            .filter(|reason| reason.is_terminal() == is_terminal);
        known
            .find(|reason| reason.as_str() == name)
            .unwrap_or(if is_terminal {
                Self::Ended
            } else {
                Self::TimeLimit
            })
    }

    /// Stable name, as in metrics and logs.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::OffRoad => "off_road",
            Self::Stuck => "stuck",
            Self::TimeLimit => "time_limit",
            Self::Ended => "ended",
        }
    }

    /// Whether the value of the last state is zero; at a time limit it is not.
    pub fn is_terminal(self) -> bool {
        self != Self::TimeLimit
    }
}

impl fmt::Display for EndReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// The ego and its neighbourhood in road coordinates: `d` grows to the left, lane 0 is the rightmost.
#[derive(Debug, Clone, PartialEq)]
pub struct PrivilegedView {
    /// Forward speed of the ego.
    pub speed_m_s: f64,
    /// Lateral position of the ego's centre, 0 in the middle of the road.
    pub d_m: f64,
    /// Heading of the ego minus that of the road, positive to the left.
    pub heading_error_rad: f64,
    /// Curvature of the lane under the ego, positive in a left bend.
    pub curvature_per_m: f64,
    /// The lane that holds the ego's centre.
    pub lane: usize,
    /// Number of lanes.
    pub lanes: usize,
    /// Width of one lane.
    pub lane_width_m: f64,
    /// Length of the ego.
    pub length_m: f64,
    /// The front wheels' greatest angle at the present speed: what steer 1 commands.
    pub max_steer_rad: f64,
    /// Distance between the ego's axles.
    pub wheelbase_m: f64,
    /// The other vehicles in no particular order.
    pub vehicles: Vec<NearbyVehicle>,
}

impl PrivilegedView {
    /// Lateral position of the centre of `lane`.
    pub fn lane_center_m(&self, lane: usize) -> f64 {
        (lane as f64 - (self.lanes as f64 - 1.0) / 2.0) * self.lane_width_m
    }
}

/// Another vehicle as [`PrivilegedView`] tells it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NearbyVehicle {
    /// How far its centre is ahead of the ego's, along the road.
    pub ahead_m: f64,
    /// Lateral position of its centre.
    pub d_m: f64,
    /// Speed along the road.
    pub speed_m_s: f64,
    /// Length.
    pub length_m: f64,
    /// Bit `i` is set if its body, or its running lane change, takes up lane `i`.
    pub lanes: u8,
}
