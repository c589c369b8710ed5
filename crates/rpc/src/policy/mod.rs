//! Policies on their way from a learner to its actors, the same for everyone who hands them out (learner, relay,
//! load generator) and for everyone who takes them in (actor, relay, load generator).
//!
//! - [`PolicyPublisher`], [`policy_service`]: announcing and serving the newest policy
//! - [`follow_policy`]: hearing of it, fetching and verifying it
//! - [`PolicyRelay`]: both, so that a learner serves a few relays instead of all actors

mod follow;
mod publisher;
mod relay;
mod service;

#[cfg(test)]
mod relay_tests;
#[cfg(test)]
mod service_tests;
#[cfg(test)]
mod testing;

pub use follow::{KeepPolicies, PolicySink, follow_policy};
pub use publisher::{Policy, PolicyPublisher, PolicyWatch};
pub use relay::PolicyRelay;
pub use service::{PolicyDesk, PolicyService, policy_service};
