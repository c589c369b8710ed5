//! The replay service end to end: a real server on loopback, real clients.

#![allow(clippy::unwrap_used)]

mod common;
mod experience;
mod full_disk;
mod gaps;
mod messages;
mod moves;
mod refusals;
mod relay;
mod shards;
mod shutdown;
mod tables;
