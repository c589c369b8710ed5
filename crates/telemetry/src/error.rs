//! The crate's one error type.

use std::io;
use std::path::{Path, PathBuf};

/// Shorthand for results of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Why something could not be logged, measured or drawn.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused a file operation.
    #[error("cannot {action} {}", path.display())]
    Io {
        /// What was tried, as a verb: `create`, `write`, ...
        action: &'static str,
        /// The file it was tried on.
        path: PathBuf,
        /// What the operating system answered.
        source: io::Error,
    },
    /// A log filter that `tracing` does not understand.
    #[error(
        "log filter `{filter}` is not valid: {reason}; write for example `info` or `info,isodream_actor=debug`"
    )]
    LogFilter {
        /// The filter as given.
        filter: String,
        /// What is wrong with it.
        reason: String,
    },
    /// Logging was set up before in this process.
    #[error(
        "logging is already initialised in this process: call init_logging once, first thing in main"
    )]
    LoggingTwice,
    /// Traces were asked for and cannot be sent.
    #[error(
        "cannot send traces to OTEL_EXPORTER_OTLP_ENDPOINT: {reason}; write for example `http://localhost:4317`"
    )]
    Traces {
        /// What stands in the way.
        reason: String,
    },
    /// A metric has the name of a column that every line has anyway.
    #[error("metric name `{name}` is taken by a column of every line: rename the metric")]
    ReservedName {
        /// The name in question.
        name: String,
    },
    /// A picture that PNG cannot hold.
    #[error("cannot encode a {width}x{height} picture as png: {reason}")]
    Png {
        /// Pixels per row.
        width: usize,
        /// Rows.
        height: usize,
        /// What the encoder answered.
        reason: String,
    },
    /// A video that cannot be encoded.
    #[error("cannot make video {}: {reason}", path.display())]
    Video {
        /// The file that was to be written.
        path: PathBuf,
        /// What stands in the way.
        reason: String,
    },
}

impl Error {
    /// For `map_err`: an [`Error::Io`] from the system's answer to doing `action` on `path`.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io {
            action,
            path,
            source,
        }
    }

    /// An [`Error::Video`] for `path`.
    pub(crate) fn video(path: &Path, reason: &dyn std::fmt::Display) -> Self {
        Self::Video {
            path: path.to_owned(),
            reason: reason.to_string(),
        }
    }
}
