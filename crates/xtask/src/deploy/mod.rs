//! `cargo xtask deploy`: what lies in `deploy/` run for real, one engine per command.

mod compose;
pub(crate) mod kubernetes;
mod slurm;

use std::path::Path;

use anyhow::Result;
use clap::Subcommand;

/// An engine that starts the roles on one machine or many.
#[derive(Debug, Subcommand)]
pub(crate) enum Deploy {
    /// deploy/compose with the debug preset: scaled, killed, out of memory, stopped; needs a Docker daemon.
    Compose(compose::ComposeArgs),
    /// deploy/k8s against the schemas of Kubernetes, itself and isodream; needs no cluster.
    Kubernetes(kubernetes::KubernetesArgs),
    /// deploy/slurm on three nodes of a Slurm of its own: killed, failed over, joined, requeued; needs root.
    Slurm(slurm::SlurmArgs),
}

/// Runs the test of one engine.
pub(crate) fn deploy(root: &Path, engine: Deploy) -> Result<()> {
    match engine {
        Deploy::Compose(args) => compose::compose(root, &args),
        Deploy::Kubernetes(args) => kubernetes::kubernetes(root, &args),
        Deploy::Slurm(args) => slurm::slurm(root, &args),
    }
}
