//! Environments over gRPC (`/proto/isodream/v1/environment.proto`): the server for ours, the client for
//! everybody's.
//!
//! Here and not in `isodream-envs`, which stays free of a network: a client is an `Environment` like any
//! other.

mod client;
mod convert;
mod link;
mod server;
mod session;

pub use client::{RemoteEnvironment, RemoteOptions};
pub use server::EnvironmentServer;
