//! What a run tells the people who watch it: logs, traces, metrics, pictures and videos.
//!
//! This crate knows no network (but for traces, with the feature `opentelemetry`), no tensors and none of Isodream's own
//! types, so that every role can use it.

mod animation;
mod csv_log;
mod error;
mod font;
mod jsonl;
mod logging;
pub mod media;
mod metrics;
mod picture;
pub mod probe;
mod tensorboard;
#[cfg(feature = "opentelemetry")]
mod traces;
mod video;
mod whole;

pub use animation::{Gif, encode_gif, write_gif};
pub use csv_log::CsvLog;
pub use error::{Error, Result};
pub use logging::{LOG_FILTER_VARIABLE, LogFormat, Logging, init_logging};
pub use metrics::{MetricsWriter, ResumePoint};
pub use picture::Rgb;
pub use tensorboard::EventWriter;
pub use video::{VideoWriter, encode_mp4, write_mp4};
pub use whole::write_whole;
