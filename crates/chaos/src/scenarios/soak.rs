//! Nothing but training, for long: memory and file descriptors have to stay what they are.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};

use super::{Context, finish};
use crate::cluster::Cluster;
use crate::interrupt;
use crate::plan::Plan;
use crate::table::Row;

/// Pause between two looks at all processes.
const LOOK: Duration = Duration::from_secs(5);

/// Share of the soak in which caches fill and the first segments and episodes come: not judged.
const WARM_UP: f64 = 0.25;

/// Memory may grow by this much in half an hour, along the line that fits best. The index of a replay-server
/// takes about 10 bytes per step, which is far below.
const GROWTH_KIB: f64 = 4096.0;

/// File descriptors likewise. The segments of a log are not counted: they are as many as there is experience.
const GROWTH_FDS: f64 = 3.0;

/// Length in seconds that growth is scaled to.
const PER_SECS: f64 = 1800.0;

/// A process at one moment.
#[derive(Debug, Clone, Copy)]
struct Look {
    secs: f64,
    /// Memory that it shares with no other, in KiB.
    anon_kib: f64,
    fds: f64,
}

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let cluster = Cluster::start(
        &context.binary,
        Plan::usual(&["learner.checkpoint_interval=100"]),
    )?;
    let begun = Instant::now();
    let mut looks: BTreeMap<String, Vec<Look>> = BTreeMap::new();
    while begun.elapsed() < context.soak {
        for role in cluster.roles() {
            let pid = role
                .pid()
                .with_context(|| format!("{} does not run", role.name()))?;
            let look = look(pid, begun)?;
            looks.entry(role.name().into()).or_default().push(look);
        }
        interrupt::sleep(LOOK)?;
    }
    let minutes = begun.elapsed().as_secs_f64() / 60.0;
    let mut rows = [Row::new(
        "none: a soak",
        &format!(
            "{minutes:.0} minutes of quiet training, RssAnon and open files of each role every 5 s"
        ),
    )];
    let row = &mut rows[0];
    row.tried = 1;
    row.notes
        .push(format!("{} updates", cluster.watch.updates()));
    for role in cluster.roles() {
        let name = role.name();
        if !role.exits().is_empty() {
            row.failures
                .push(format!("{name} ended and was started again"));
        }
        let judged = looks.remove(name).unwrap_or_default();
        let from = (judged.len() as f64 * WARM_UP) as usize;
        judge(name, judged.get(from..).unwrap_or_default(), row);
    }
    let since = cluster.begun();
    finish(cluster, since, 0, &mut rows)?;
    Ok(rows.into())
}

fn look(pid: u32, begun: Instant) -> Result<Look> {
    let status = fs::read_to_string(format!("/proc/{pid}/status"))?;
    let anon = status
        .lines()
        .find_map(|line| line.strip_prefix("RssAnon:"));
    let anon = anon.context("no RssAnon in the status of a process")?;
    Ok(Look {
        secs: begun.elapsed().as_secs_f64(),
        anon_kib: anon.trim().trim_end_matches(" kB").parse()?,
        fds: open_files(pid)? as f64,
    })
}

/// Files, sockets and the like that a process holds open, but for segments of a log.
fn open_files(pid: u32) -> Result<usize> {
    let entries = fs::read_dir(format!("/proc/{pid}/fd"))?;
    let links = entries
        .flatten()
        .filter_map(|entry| fs::read_link(entry.path()).ok());
    let is_segment = |link: &Path| {
        let name = link.file_name().unwrap_or_default();
        name.to_string_lossy().starts_with("segment-")
    };
    Ok(links.filter(|link| !is_segment(link)).count())
}

/// Notes what a role took, and what it took more and more of.
fn judge(name: &str, looks: &[Look], row: &mut Row) {
    let (Some(first), Some(last)) = (looks.first(), looks.last()) else {
        row.failures.push(format!("{name} was not looked at"));
        return;
    };
    let memory = growth(looks, |look| look.anon_kib);
    let fds = growth(looks, |look| look.fds);
    row.notes.push(format!(
        "{name}: RssAnon {:.1} MiB after warm-up, {:.1} at the end, grows by {:.2} MiB in 30 min; files {} and {}, grow by {fds:.1}",
        first.anon_kib / 1024.0,
        last.anon_kib / 1024.0,
        memory / 1024.0,
        first.fds,
        last.fds,
    ));
    if memory > GROWTH_KIB || fds > GROWTH_FDS {
        row.failures.push(format!(
            "{name} grows by {memory:.0} KiB and {fds:.1} files in 30 min, more than {GROWTH_KIB} and {GROWTH_FDS}"
        ));
    }
}

/// Slope of the line of least squares, over half an hour.
fn growth(looks: &[Look], value: impl Fn(&Look) -> f64) -> f64 {
    let count = looks.len() as f64;
    let mean_at = looks.iter().map(|look| look.secs).sum::<f64>() / count;
    let mean = looks.iter().map(&value).sum::<f64>() / count;
    let (mut covariance, mut variance) = (0.0, 0.0);
    for look in looks {
        covariance += (look.secs - mean_at) * (value(look) - mean);
        variance += (look.secs - mean_at).powi(2);
    }
    if variance > 0.0 {
        covariance / variance * PER_SECS
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn looks(anon_kib: impl Fn(f64) -> f64) -> Vec<Look> {
        let looks = (0..200).map(|look| {
            let secs = 5.0 * f64::from(look);
            Look {
                secs,
                anon_kib: anon_kib(secs),
                fds: 20.0,
            }
        });
        looks.collect()
    }

    #[test]
    fn a_leak_is_found_and_a_sawtooth_is_none() {
        let mut row = Row::new("soak", "");
        judge(
            "flat",
            &looks(|secs| 50_000.0 + 3000.0 * (secs / 60.0).fract()),
            &mut row,
        );
        assert_eq!(row.failures, [""; 0]);
        judge("leaking", &looks(|secs| 50_000.0 + 4.0 * secs), &mut row);
        assert_eq!(row.failures.len(), 1, "{row:?}");
        assert!(row.failures[0].contains("leaking grows by 7200 KiB"));
    }
}
