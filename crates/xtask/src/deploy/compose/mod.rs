//! `cargo xtask deploy compose`: `deploy/compose/compose.yaml` run for real.

use std::path::Path;

use anyhow::Result;
use clap::Args;

use crate::docker;

/// Options of `cargo xtask deploy compose`.
#[derive(Debug, Args)]
pub(crate) struct ComposeArgs {}

/// Runs the composition through everything that it must survive.
pub(crate) fn compose(_root: &Path, _args: &ComposeArgs) -> Result<()> {
    docker::daemon()
}
