//! Scripted drivers: yardsticks for a learned one, and a source of varied episodes.

mod controls;
mod foreseeing;
mod reacting;
mod score;
mod simple;
mod wander;

use std::fmt;
use std::str::FromStr;

pub use self::foreseeing::ForeseeingDriver;
pub use self::reacting::ReactingDriver;
pub use self::score::{Score, score};
pub use self::simple::{BlindDriver, KeepLaneDriver, RandomDriver, StandStillDriver};
pub use self::wander::WanderDriver;
use crate::highway::{BARRIER_D, EGO_WIDTH};
use crate::{EnvError, Environment};

/// The pedal that earns most on the highway if it is held for a whole episode.
pub const BEST_BLIND_PEDAL: f32 = 0.07;

/// Pedals among which the best one is looked for: close together where cruising is.
pub const BLIND_PEDALS: [f32; 16] = [
    -0.5, 0.0, 0.04, 0.06, 0.07, 0.08, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0,
];

/// Lateral position next to the right barrier of the highway, a hand's breadth away from it.
pub const SHOULDER_D_M: f64 = EGO_WIDTH / 2.0 + 0.1 - BARRIER_D;

/// Chooses actions by looking at the world itself, not at its image.
pub trait Driver: Send {
    /// The action for the present state of `env`.
    ///
    /// # Errors
    /// If `env` shows no [`PrivilegedView`](crate::PrivilegedView) and the driver needs one.
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError>;
}

/// The scripted drivers by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScriptedDriver {
    /// [`ForeseeingDriver`].
    Foreseeing,
    /// [`ReactingDriver`].
    Reacting,
    /// [`KeepLaneDriver`].
    KeepLane,
    /// [`BlindDriver`] with [`BEST_BLIND_PEDAL`].
    Blind,
    /// [`StandStillDriver`].
    StandStill,
    /// [`RandomDriver`].
    Random,
    /// [`WanderDriver`].
    Wander,
}

impl ScriptedDriver {
    /// All drivers, the best one first.
    pub const ALL: [Self; 7] = [
        Self::Foreseeing,
        Self::Reacting,
        Self::KeepLane,
        Self::Blind,
        Self::StandStill,
        Self::Random,
        Self::Wander,
    ];

    /// Stable name, as on command lines and in metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Foreseeing => "foreseeing",
            Self::Reacting => "reacting",
            Self::KeepLane => "keep_lane",
            Self::Blind => "blind",
            Self::StandStill => "stand_still",
            Self::Random => "random",
            Self::Wander => "wander",
        }
    }

    /// A fresh driver; `seed` matters to those that draw their actions. Make one per episode.
    pub fn driver(self, seed: u64) -> Box<dyn Driver> {
        match self {
            Self::Foreseeing => Box::new(ForeseeingDriver::default()),
            Self::Reacting => Box::new(ReactingDriver::default()),
            Self::KeepLane => Box::new(KeepLaneDriver::default()),
            Self::Blind => Box::new(BlindDriver::new(BEST_BLIND_PEDAL)),
            Self::StandStill => Box::new(StandStillDriver),
            Self::Random => Box::new(RandomDriver::new(seed)),
            Self::Wander => Box::new(WanderDriver::new(seed)),
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
