//! Scripted drivers: yardsticks for a learned one, and a source of varied episodes for tests.

mod controls;
mod overtake;
mod simple;

use std::fmt;
use std::str::FromStr;

pub use self::overtake::{CutInDriver, OvertakeDriver};
pub use self::simple::{KeepLaneDriver, RandomDriver, RecklessDriver, StandStillDriver};
use crate::{EnvError, Environment};

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
    /// [`KeepLaneDriver`].
    KeepLane,
    /// [`OvertakeDriver`].
    Overtake,
    /// [`RandomDriver`].
    Random,
    /// [`CutInDriver`].
    CutIn,
    /// [`RecklessDriver`].
    Reckless,
    /// [`StandStillDriver`].
    StandStill,
}

impl ScriptedDriver {
    /// All drivers.
    pub const ALL: [Self; 6] = [
        Self::KeepLane,
        Self::Overtake,
        Self::CutIn,
        Self::Reckless,
        Self::Random,
        Self::StandStill,
    ];

    /// Stable name, as on command lines and in metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::KeepLane => "keep_lane",
            Self::Overtake => "overtake",
            Self::Random => "random",
            Self::CutIn => "cut_in",
            Self::Reckless => "reckless",
            Self::StandStill => "stand_still",
        }
    }

    /// A fresh driver; `seed` matters to the random one only. Make one per episode.
    pub fn driver(self, seed: u64) -> Box<dyn Driver> {
        match self {
            Self::KeepLane => Box::new(KeepLaneDriver::default()),
            Self::Overtake => Box::new(OvertakeDriver::default()),
            Self::Random => Box::new(RandomDriver::new(seed)),
            Self::CutIn => Box::new(CutInDriver::default()),
            Self::Reckless => Box::new(RecklessDriver::default()),
            Self::StandStill => Box::new(StandStillDriver),
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
