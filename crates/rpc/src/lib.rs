//! Every transport decision, once: connections, security, deadlines, caps, retries, shutdown.
//!
//! - [`Dialer`]: connections with this project's limits ([`limits`]) and a process's [`Credentials`]
//! - [`bind`], [`server`], [`serve`]: the skeleton of every server, behind its [`Door`]
//! - [`ServiceError`]: the one mapping between errors and gRPC status; [`is_refusal`] reads it back
//! - [`shutdown_on_signal`], [`reconnect_delays`]
//! - [`AppendClient`], [`SampleClient`]: the two ends of experience over any number of replay-servers, which
//!   reconnect by themselves; [`Network`] is the seam for a simulated network
//! - [`PolicyPublisher`], [`follow_policy`], [`PolicyRelay`]: policies from the learner to its actors
//! - [`open_environments`]: environments as a configuration names them, here or in other processes
//!   ([`EnvironmentServer`], [`RemoteEnvironment`])

mod append_client;
mod append_link;
mod append_route;
mod backoff;
mod courier;
mod dialer;
mod environment;
mod error;
pub mod limits;
mod link_state;
mod network;
mod policy;
mod priorities;
mod sample_client;
mod sample_link;
mod sample_merge;
mod sample_watch;
mod security;
mod sequence;
mod server;
mod shutdown;
mod spool;

pub use append_client::{AppendClient, AppendOptions};
pub use backoff::{reconnect_delays, retry};
pub use dialer::{Dialer, LearnerClient, ReplayClient, Wire};
pub use environment::{
    ENVIRONMENT_PATIENCE, EnvironmentServer, RemoteEnvironment, RemoteOptions, environment_spec,
    open_environment, open_environments, remote_address,
};
pub use error::{RpcError, ServiceError, is_refusal};
pub use network::{Network, Resolving, Tcp};
pub use policy::{
    KeepPolicies, Policy, PolicyDesk, PolicyPublisher, PolicyRelay, PolicyService, PolicySink,
    PolicyWatch, follow_policy, policy_service,
};
pub use priorities::{PriorityHandle, PriorityUpdate};
pub use sample_client::{SampleClient, SampleOptions, SampledSequence};
pub use sample_watch::SampleWatch;
pub use security::{Bearer, Credentials, Door, Files, GuardLayer, Role, SecurityError, Tokens};
pub use sequence::SequenceError;
pub use server::{
    Connection, GuardedRouter, GuardedServer, bind, serve, serve_connections, server, serving,
};
pub use shutdown::shutdown_on_signal;
pub use spool::AcknowledgedChunks;
