//! Types that every part of Isodream shares: environment specs, steps, chunks and their codec,
//! the seed tree, and the configuration with its presets.
//!
//! This crate knows no network, no async runtime and no tensor library.

pub mod codec;
pub mod config;
mod seed;
mod spec;
mod step;

pub use config::Config;
pub use seed::derive_seed;
pub use spec::{EnvSpec, ImageShape};
pub use step::{Chunk, EpisodeId, Step, Steps};
