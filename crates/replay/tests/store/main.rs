//! A store through its public door: exactly once, restarts, retention, draws.

#![allow(clippy::unwrap_used)]

mod common;
mod drawing;
mod positions;
mod retention;
