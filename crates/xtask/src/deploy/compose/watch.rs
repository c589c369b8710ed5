//! How far the run is: what replay-server and learner show of themselves.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

use super::project::{Project, inspect};
use crate::docker::docker;

/// The machine may be busy with other things; a run that has not moved by then will not.
const PATIENCE: Duration = Duration::from_secs(240);

/// Pause between two looks.
const PAUSE: Duration = Duration::from_millis(500);

/// The replay-server's folder in its container.
pub(super) const REPLAY_DIR: &str = "/var/lib/isodream/replay";

const METRICS_FILE: &str = "/var/lib/isodream/run/metrics.jsonl";

/// How far a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Progress {
    /// Steps that the replay-server acknowledged, over its whole life.
    pub(super) inserted: u64,
    /// Updates of the learner's last line of metrics.
    pub(super) updates: u64,
}

impl Progress {
    /// The further of both, in each of its parts.
    pub(super) fn max(self, other: Self) -> Self {
        Self {
            inserted: self.inserted.max(other.inserted),
            updates: self.updates.max(other.updates),
        }
    }
}

/// Follows a run, and notices if acknowledged steps are gone.
#[derive(Debug)]
pub(super) struct Watch<'a> {
    project: &'a Project,
    acknowledged: Acknowledged,
}

/// The most steps that a replay-server ever acknowledged.
#[derive(Debug, Default)]
struct Acknowledged(u64);

impl Acknowledged {
    /// Fails where `inserted` is less than there were.
    fn note(&mut self, inserted: u64) -> Result<()> {
        ensure!(
            inserted >= self.0,
            "acknowledged steps were lost: the replay-server had {} and has {inserted}",
            self.0
        );
        self.0 = inserted;
        Ok(())
    }
}

impl<'a> Watch<'a> {
    pub(super) fn new(project: &'a Project) -> Self {
        Self {
            project,
            acknowledged: Acknowledged::default(),
        }
    }

    /// Where the run is after its first updates; none before.
    pub(super) fn first(&mut self) -> Result<Option<Progress>> {
        Ok(self.look()?.filter(|progress| progress.updates > 0))
    }

    /// Where the run is, once both servers show it.
    pub(super) fn progress(&mut self) -> Result<Progress> {
        wait("answers of replay-server and learner", || self.look())
    }

    /// Waits until both went beyond `before`.
    pub(super) fn beyond(&mut self, before: Progress) -> Result<Progress> {
        wait("steps and updates beyond those before", || {
            let now = self.look()?;
            Ok(now.filter(|now| now.inserted > before.inserted && now.updates > before.updates))
        })
    }

    /// None while one of them does not show it.
    fn look(&mut self) -> Result<Option<Progress>> {
        let Some(inserted) = self.metrics().as_deref().and_then(inserted_steps) else {
            return Ok(None);
        };
        self.acknowledged.note(inserted)?;
        Ok(self.updates().map(|updates| Progress { inserted, updates }))
    }

    /// The replay-server's metrics as Prometheus would get them; none while it does not answer.
    pub(super) fn metrics(&self) -> Option<String> {
        let replay = inspect(&self.project.container("replay").ok()?).ok()?;
        let answer = get(&format!("{}:9100", replay.address()?), "/metrics", "").ok()?;
        Some(answer.split_once("\r\n\r\n")?.1.to_owned())
    }

    fn updates(&self) -> Option<u64> {
        let learner = self.project.container("learner").ok()?;
        let copy = self.project.folder.join("metrics.jsonl");
        let from = format!("{learner}:{METRICS_FILE}");
        docker(&["cp", &from, copy.to_str()?]).ok()?;
        last_updates(&fs::read_to_string(copy).ok()?)
    }
}

/// A whole answer over HTTP, head and body; `headers` are lines.
pub(super) fn get(address: &str, path: &str, headers: &str) -> Result<String> {
    let limit = Duration::from_secs(2);
    let mut stream = TcpStream::connect_timeout(&address.parse()?, limit)?;
    stream.set_read_timeout(Some(limit))?;
    write!(
        stream,
        "GET {path} HTTP/1.0\r\nHost: {address}\r\n{headers}\r\n"
    )?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    Ok(answer)
}

/// Asks until there is an answer.
pub(super) fn wait<T>(what: &str, mut ask: impl FnMut() -> Result<Option<T>>) -> Result<T> {
    let begun = Instant::now();
    loop {
        if let Some(answer) = ask().with_context(|| format!("waiting for {what}"))? {
            return Ok(answer);
        }
        if begun.elapsed() > PATIENCE {
            bail!("no {what} in {} s", PATIENCE.as_secs());
        }
        sleep(PAUSE);
    }
}

/// Whether the replay-server of `container` knows `actor` by steps that it stored.
pub(super) fn has_steps_of(container: &str, actor: &str) -> Result<bool> {
    let args = [
        "exec",
        container,
        "/usr/local/bin/isodream",
        "replay",
        "inspect",
        REPLAY_DIR,
    ];
    let printed = docker(&args)?;
    Ok(printed.lines().any(|line| {
        let mut words = line.split_whitespace();
        words.next() == Some("actor") && words.next() == Some(actor)
    }))
}

fn inserted_steps(metrics: &str) -> Option<u64> {
    let line = metrics
        .lines()
        .find(|line| line.starts_with("replay_inserted_steps_total "))?;
    line.split(' ').nth(1)?.parse().ok()
}

/// Of the last whole line that counts updates.
fn last_updates(lines: &str) -> Option<u64> {
    lines.lines().rev().find_map(|line| {
        let line: Value = serde_json::from_str(line).ok()?;
        Some(line["train/updates"].as_f64()? as u64)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_steps_than_before_are_lost_ones() {
        let mut acknowledged = Acknowledged::default();
        acknowledged.note(20).unwrap();
        acknowledged.note(20).unwrap();
        let error = acknowledged.note(19).unwrap_err().to_string();
        assert!(error.ends_with("had 20 and has 19"), "{error}");
    }

    #[test]
    fn counts_are_read_from_what_the_servers_show() {
        let metrics =
            "# TYPE replay_inserted_steps_total counter\nreplay_inserted_steps_total 323\n";
        assert_eq!(inserted_steps(metrics), Some(323));
        assert_eq!(inserted_steps("replay_steps 3\n"), None);

        let lines = "{\"train/updates\":5.0}\n{\"train/updates\":10.0}\n{\"episode/score\":1.0}\n{\"train/upd";
        assert_eq!(last_updates(lines), Some(10));
        assert_eq!(last_updates("{\"episode/score\":1.0}\n"), None);
    }
}
