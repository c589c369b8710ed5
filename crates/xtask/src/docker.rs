//! Docker as this machine has it.

use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};

use crate::stage::{answers, line};

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

/// What `docker args` prints.
pub(crate) fn docker(args: &[&str]) -> Result<String> {
    quiet(Command::new("docker").args(args))
}

/// What `command` prints on stdout; what it says on stderr is told where it fails only.
pub(crate) fn quiet(command: &mut Command) -> Result<String> {
    let output = command
        .stdin(Stdio::null())
        .output()
        .with_context(|| format!("cannot start {}", command.get_program().display()))?;
    if !output.status.success() {
        bail!(
            "{} ended with {}: {}",
            line(command),
            output.status,
            String::from_utf8_lossy(&output.stderr).trim()
        );
    }
    Ok(String::from_utf8(output.stdout)?)
}
