//! The dashboard: one page that shows runs while they train, and afterwards.
//!
//! It reads run directories and asks the roles of a live run how they are; nothing depends on it. The page is plain
//! HTML, CSS and JavaScript in `assets/`, inside the binary, and loads nothing from elsewhere. It asks again every two
//! seconds: unlike a pushed stream, that survives restarts on either side and every proxy without a line of code.
//!
//! | request | answer |
//! |---|---|
//! | `GET /` | the page |
//! | `GET /api/runs` | [`Overview`]: every run below the root, newest first |
//! | `GET /api/series?run=ID&metric=NAME` | [`Series`]: one metric over environment frames |
//! | `GET /api/media?run=ID` | [`Media`]: which episodes and panels there are |
//! | `GET /api/file?run=ID&name=NAME` | a file of the run's `media/`, ranges included |
//! | `GET /api/live` | [`Live`]: what learner and replay-servers say of themselves |
//!
//! [`serve`] is everything; a [`Guard`] decides who may look.

mod guard;
mod live;
mod media;
mod routes;
mod runs;
mod series;

pub use guard::{Guard, GuardError};
pub use live::{ActorView, LearnerView, Live, ReplayView, Sources};
pub use media::Media;
pub use runs::{Evaluation, Overview, Run};
pub use series::Series;

use std::path::PathBuf;

use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

/// What a dashboard shows, and to whom.
#[derive(Debug)]
pub struct Options {
    /// A run directory, or a folder of them.
    pub root: PathBuf,
    /// The roles of a live run; none where runs are only read.
    pub sources: Option<Sources>,
    /// Who may look.
    pub guard: Guard,
}

/// Serves until `shutdown`.
///
/// # Errors
/// Where the listener fails.
pub async fn serve(
    listener: TcpListener,
    options: Options,
    shutdown: CancellationToken,
) -> std::io::Result<()> {
    axum::serve(listener, routes::router(options))
        .with_graceful_shutdown(shutdown.cancelled_owned())
        .await
}
