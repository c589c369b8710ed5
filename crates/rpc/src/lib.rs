//! Every transport decision, once: channels, deadlines, caps, retries, shutdown.
//!
//! - [`replay_client`], [`learner_client`]: connections with this project's limits ([`limits`])
//! - [`bind`], [`server`], [`serve`]: the skeleton of every server
//! - [`ServiceError`]: the one mapping between errors and gRPC status; [`is_refusal`] reads it back
//! - [`shutdown_on_signal`], [`reconnect_delays`]
//! - [`AppendClient`], [`SampleClient`]: the two ends of experience over any number of replay-servers, which
//!   reconnect by themselves; [`Network`] is the seam for a simulated network
//! - [`open_environments`]: environments as a configuration names them, here or in other processes
//!   ([`EnvironmentServer`], [`RemoteEnvironment`])

mod append_client;
mod append_link;
mod append_route;
mod backoff;
mod channel;
mod environment;
mod error;
pub mod limits;
mod link_state;
mod network;
mod priorities;
mod sample_client;
mod sample_link;
mod sample_merge;
mod sample_watch;
mod sequence;
mod server;
mod shutdown;
mod spool;

pub use append_client::{AppendClient, AppendOptions};
pub use backoff::{reconnect_delays, retry};
pub use channel::{channel, learner_client, replay_client};
pub use environment::{
    ENVIRONMENT_PATIENCE, EnvironmentServer, RemoteEnvironment, RemoteOptions, environment_spec,
    open_environment, open_environments, remote_address,
};
pub use error::{RpcError, ServiceError, is_refusal};
pub use network::{Network, Resolving, Tcp};
pub use priorities::{PriorityHandle, PriorityUpdate};
pub use sample_client::{SampleClient, SampleOptions, SampledSequence};
pub use sample_watch::SampleWatch;
pub use sequence::SequenceError;
pub use server::{Connection, bind, serve, serve_connections, server, serving};
pub use shutdown::shutdown_on_signal;
