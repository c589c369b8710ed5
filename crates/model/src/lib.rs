//! The Iso-Dream++ agent: decoupled world model, behaviour learning in isolated imaginations, and the
//! policy that actors deploy.
//!
//! | equation | where |
//! |---|---|
//! | 3, transitions of both branches | [`rssm`] |
//! | 4, inverse dynamics | [`world_model`] |
//! | 5, composition of the three branches | [`decoder`] |
//! | 6, 8-10, world-model losses | [`losses`], [`world_model`], `variance` |
//! | 11, 12, dependency gate | [`gate`] |
//! | 13, future-state attention | [`attention`] |
//! | 14, actor and critic | [`policy`], [`behavior`] |
//!
//! Tensors are batch-first: `[B, T, ...]`; lists over time appear only inside scans. Images are
//! `[.., 3, 64, 64]` floats in `[-0.5, 0.5]`.

pub mod agent;
pub mod attention;
pub mod batch;
pub mod behavior;
pub mod chunked;
pub mod cost;
pub mod decoder;
pub mod distribution;
pub mod encoder;
pub mod gate;
pub mod gate_evidence;
pub mod laps;
pub mod losses;
pub mod nn;
pub mod noise;
pub mod open_loop;
pub mod optimizer;
pub mod params;
pub mod policy;
pub mod precision;
pub mod reward;
pub mod rssm;
mod variance;
pub mod world_model;

pub use agent::Agent;
pub use batch::Batch;
pub use params::{LoadError, Params};
pub use policy::{ActingModel, Actions, Decision};
pub use reward::RewardModel;
