//! A real server process that dies for real.

#![allow(clippy::unwrap_used)]

mod kills;
mod peers;
mod process;
