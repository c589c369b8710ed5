//! Environments: what a world must offer ([`Environment`]), the built-in highway simulator, and the
//! scripted drivers that say what a return is worth.
//!
//! ```
//! use isodream_core::config::EnvConfig;
//! use isodream_envs::{ScriptedDriver, make};
//!
//! let mut env = make(&EnvConfig::default())?;
//! let mut driver = ScriptedDriver::KeepLane.driver(0);
//! let first = env.reset(7)?;
//! assert_eq!(first.image.len(), env.spec().image.bytes());
//! let action = driver.act(env.as_ref())?;
//! let next = env.step(&action)?;
//! assert!(!next.is_last);
//! # Ok::<(), isodream_envs::EnvError>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used, clippy::print_stdout))]

#[cfg(feature = "mujoco")]
pub mod dmc;
mod driver;
mod environment;
mod error;
mod geometry;
mod highway;
mod registry;
mod render;

pub use driver::{
    CutInDriver, Driver, KeepLaneDriver, OvertakeDriver, RandomDriver, RecklessDriver,
    ScriptedDriver, StandStillDriver,
};
pub use environment::{EndReason, Environment, NearbyVehicle, PrivilegedView, Transition, class};
pub use error::EnvError;
pub use highway::{TrafficReport, traffic_without_collisions};
pub use registry::{ids, make, spec};
