//! Environments over gRPC (`/proto/isodream/v1/environment.proto`): the server for ours, the client for
//! everybody's.
//!
//! Here and not in `isodream-envs`, which stays free of a network: a client is an `Environment` like any
//! other.

mod client;
mod convert;
mod link;
mod open;
mod server;
mod session;
mod stock;

pub use client::{RemoteEnvironment, RemoteOptions};
pub use open::{
    ENVIRONMENT_PATIENCE, environment_spec, open_environment, open_environments, remote_address,
};
pub use server::EnvironmentServer;
