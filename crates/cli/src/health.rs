//! `isodream health`: whether a server serves, for whoever restarts it.

use std::time::Duration;

use anyhow::Context;
use clap::Args;

use crate::security::ClientArgs;

/// Options of `isodream health`.
#[derive(Debug, Args)]
pub(crate) struct HealthArgs {
    /// The server, `host:port`
    address: String,
    /// Seconds that the answer may take
    #[arg(long, default_value_t = 5.0)]
    timeout: f64,
    #[command(flatten)]
    security: ClientArgs,
}

/// Asks, and fails unless the answer is that it serves.
pub(crate) async fn run(args: HealthArgs) -> anyhow::Result<()> {
    let limit = Duration::try_from_secs_f64(args.timeout)
        .with_context(|| format!("--timeout {}: must be a positive number", args.timeout))?;
    let dialer = args.security.dialer_without_token()?;
    Ok(dialer.check_health(&args.address, limit).await?)
}
