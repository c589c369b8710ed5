//! Signals.

use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use crate::RpcError;

/// A token that SIGINT or SIGTERM cancels. Further signals are ignored: shutting down is under way.
///
/// # Errors
/// [`RpcError::Signal`] where the handlers cannot be installed.
///
/// # Panics
/// Outside a tokio runtime.
pub fn shutdown_on_signal() -> Result<CancellationToken, RpcError> {
    let failed = |error: std::io::Error| RpcError::Signal(error.to_string());
    let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
    let token = CancellationToken::new();
    let cancelled = token.clone();
    tokio::spawn(async move {
        let name = tokio::select! {
            _ = interrupt.recv() => "SIGINT",
            _ = terminate.recv() => "SIGTERM",
        };
        tracing::info!(signal = name, "shutting down");
        cancelled.cancel();
    });
    Ok(token)
}
