//! Docker as this machine has it: whether it answers, and what to do where it does not.

use std::process::Command;

use anyhow::{Result, bail};

use crate::stage::answers;

/// Fails with the cure where no Docker daemon answers.
pub(crate) fn daemon() -> Result<()> {
    if !answers(Command::new("docker").arg("--version")) {
        bail!(
            "docker is missing: install it (Debian, Ubuntu: apt-get install docker.io) and start its daemon"
        );
    }
    if !answers(Command::new("docker").arg("info")) {
        bail!(
            "no Docker daemon answers: start it (systemctl start docker, or dockerd as root), or point DOCKER_HOST at \
             one that this user may use"
        );
    }
    Ok(())
}
