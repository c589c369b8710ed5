//! Actors: they step environments, act by the newest published policy, and hand experience to replay.
//!
//! - [`collect`]: samples actions and appends every step to a replay-server
//! - [`evaluate`]: acts by the mode, never writes to replay, reports scores
//! - [`probe`]: what other actions bring, really and as the world model imagines it
//! - [`rollout`]: one episode under any policy, for evaluation and pictures
//!
//! An actor is disposable. It may be killed at any moment: what it handed over and got acknowledged is kept by
//! the replay-server, and its successor starts a new epoch.

mod agent;
mod chunks;
pub mod collect;
mod collector;
pub mod evaluate;
mod exploration;
mod failures;
mod film;
mod lane;
mod learner_link;
pub mod probe;
mod report;
pub mod rollout;

pub use agent::{AgentPolicy, Insight};

use isodream_core::{Config, EnvSpec};
use isodream_proto::Identity;
use isodream_rpc::Dialer;

/// Settings of an actor.
#[derive(Debug, Clone)]
pub struct ActorOptions {
    /// The run's configuration.
    pub config: Config,
    /// Stable name, unique in the run.
    pub actor_id: String,
    /// The replay-servers, `host:port`; unused by an evaluating actor.
    pub replay: Vec<String>,
    /// The learner, `host:port`.
    pub learner: String,
    /// How both, and environments of other processes, are reached.
    pub dialer: Dialer,
}

impl ActorOptions {
    fn identity(&self, spec: &EnvSpec) -> Identity {
        Identity::new(spec, self.config.model_hash())
    }
}
