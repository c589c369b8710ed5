//! What happens to containers: their process is killed, by hand or for the memory it uses.

use std::process::Command;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, ensure};

use super::project::{Project, inspect};
use super::table::Table;
use super::watch::{Watch, wait};
use crate::docker::docker;
use crate::stage::run;

/// Fills the container's memory, in a process that the kernel would rather keep than the role: so the role is killed,
/// as it would be if the memory were its own. The role ends, and with it everything in the container.
const HOG: &str = "echo 1000 > /proc/1/oom_score_adj && x=$(head -c 4G /dev/zero | tr '\\0' x)";

/// Kills the process of `service`, and waits until it is back and the run has moved on.
pub(super) fn kill(
    project: &Project,
    watch: &mut Watch<'_>,
    service: &str,
    table: &mut Table,
) -> Result<()> {
    survived(project, watch, service, table, "kill -9", |id| {
        // Not `docker kill`: a container that was stopped by hand is not restarted.
        let pid = inspect(id)?.pid();
        ensure!(pid > 1, "{id} has no process");
        run(Command::new("kill").args(["-9", &pid.to_string()]))?;
        Ok(Instant::now())
    })
}

/// Lets `service` meet its memory limit, and waits until it is back and the run has moved on.
pub(super) fn out_of_memory(
    project: &Project,
    watch: &mut Watch<'_>,
    service: &str,
    table: &mut Table,
) -> Result<()> {
    let since = now()?;
    survived(project, watch, service, table, "out of memory", |id| {
        // Ends with an error, because everything in the container ends.
        let _ = docker(&["exec", id, "bash", "-c", HOG]);
        let ended = Instant::now();
        wait("word from Docker that memory ran out", || {
            let seen = events(project, since, service, "oom")?;
            Ok((!seen.is_empty()).then_some(ended))
        })
    })
}

/// `fault` says when the process ended.
fn survived(
    project: &Project,
    watch: &mut Watch<'_>,
    service: &str,
    table: &mut Table,
    what: &str,
    fault: impl FnOnce(&str) -> Result<Instant>,
) -> Result<()> {
    let id = project.container(service)?;
    let restarts = inspect(&id)?.restarts();
    let before = watch.progress()?;
    let begun = fault(&id)?;
    wait("the container again", || {
        let container = inspect(&id)?;
        Ok((container.restarts() > restarts && container.is_running()).then_some(()))
    })?;
    // What was still done before the fault came does not count, nor what is done again.
    let again = watch.progress()?;
    let after = watch.beyond(before.max(again))?;
    table.add(&format!("{service}: {what}"), begun, Some(before), after);
    Ok(())
}

/// Exit codes of the containers of `service` that ended since then.
pub(super) fn exit_codes(project: &Project, since: u64, service: &str) -> Result<Vec<i64>> {
    events(project, since, service, "die")?
        .iter()
        .map(|code| {
            code.parse()
                .with_context(|| format!("docker says that a container ended with `{code}`"))
        })
        .collect()
}

/// What Docker noted of the containers of `service` since then: the exit code of each event, empty for those without.
fn events(project: &Project, since: u64, service: &str, event: &str) -> Result<Vec<String>> {
    let printed = docker(&[
        "events",
        "--since",
        &since.to_string(),
        "--until",
        &now()?.to_string(),
        "--filter",
        &format!("event={event}"),
        "--filter",
        &format!("label=com.docker.compose.project={}", project.name),
        "--filter",
        &format!("label=com.docker.compose.service={service}"),
        "--format",
        "{{.Actor.Attributes.exitCode}}",
    ])?;
    Ok(printed.lines().map(str::to_owned).collect())
}

/// Seconds since 1970, as Docker counts them.
pub(super) fn now() -> Result<u64> {
    Ok(SystemTime::now().duration_since(UNIX_EPOCH)?.as_secs())
}
