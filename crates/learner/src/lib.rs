//! The learner: it draws sequences from replay, trains the agent, publishes policies, and keeps checkpoints.
//!
//! ```text
//! replay-server ──Sample──▶ sampler thread ──▶ decoder threads ──▶ training thread ──▶ metrics
//!                                                                        │   └──▶ saver thread ──▶ checkpoints
//!                                            actors ◀──WatchPolicy── service ◀──ReportEpisode── actors
//! ```
//!
//! - [`run`]: the whole role
//! - [`checkpoint`]: what lies in `checkpoints/` and how it is loaded
//! - [`panel`]: the open-loop prediction as a picture and a video
//!
//! A learner never touches an environment. Killed at any moment, it goes on from its newest valid checkpoint.

mod beginning;
pub mod checkpoint;
mod evaluations;
mod media;
pub mod panel;
mod progress;
mod run_lock;
mod sampling;
mod saver;
mod service;
mod train;

use std::path::PathBuf;

use isodream_core::{Config, EnvSpec};
use isodream_rpc::{Dialer, Door};
use tch::Device;

pub use run_lock::lock;
pub use train::{Finished, run};

/// Settings of a learner.
#[derive(Debug, Clone)]
pub struct LearnerOptions {
    /// The run's configuration.
    pub config: Config,
    /// The environment that actors step.
    pub spec: EnvSpec,
    /// Where checkpoints and metrics go.
    pub run_dir: PathBuf,
    /// Where actors find this learner, `host:port`.
    pub listen: String,
    /// The replay-servers, `host:port`.
    pub replay: Vec<String>,
    /// How the replay-servers are reached.
    pub dialer: Dialer,
    /// Who may come in.
    pub door: Door,
    /// Where tensors live.
    pub device: Device,
}
