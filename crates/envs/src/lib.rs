//! Environments: what a world must offer ([`Environment`]), the built-in highway simulator, and the
//! scripted drivers that say what a return is worth.
//!
//! - [`ids`], [`spec`], [`make`]: worlds by their stable names
//! - [`VectorEnvironment`]: many of them, stepped together
//! - [`Guard`], [`Noisy`], [`Resize`], [`TimeLimit`], [`ActionRepeat`], [`Statistics`]: environments around
//!   environments
//! - [`Backgrounds`], [`BackgroundPlayer`]: videos behind rendered pictures
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

mod backgrounds;
mod conform;
#[cfg(feature = "mujoco")]
pub mod dmc;
mod driver;
mod environment;
mod error;
#[cfg(test)]
mod fixture;
mod geometry;
mod highway;
mod id;
mod noise;
pub mod raycast;
mod registry;
mod render;
mod resize;
mod vector;
mod wrappers;

pub use backgrounds::{
    BackgroundPlayer, BackgroundSource, Backgrounds, VideoOrder, VideoSet, compose, is_background,
};
pub use conform::{conform, conformed_spec};
pub use driver::{
    BEST_BLIND_PEDAL, BLIND_PEDALS, BlindDriver, Driver, ForeseeingDriver, KeepLaneDriver,
    RandomDriver, ReactingDriver, SHOULDER_D_M, Score, ScriptedDriver, StandStillDriver,
    WanderDriver, score,
};
pub use environment::{
    EndReason, Environment, NearbyVehicle, Outlook, PrivilegedView, Simulator, Transition, class,
};
pub use error::{EnvError, RemoteFault};
pub use highway::{TrafficReport, traffic_without_collisions};
pub use noise::{GaussianNoise, NoiseTarget};
pub use registry::{ids, make, make_without_pictures, spec, steps_per_s};
pub use vector::{NextEpisode, VectorEnvironment, VectorStep, common_spec};
pub use wrappers::{ActionRepeat, Guard, Noisy, Resize, Statistics, TimeLimit, check_transition};
