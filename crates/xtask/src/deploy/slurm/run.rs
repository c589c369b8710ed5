//! A run inside the cluster, seen from outside: its job, its folder, its processes.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

use super::cluster::{Cluster, Job};
use crate::stage::{output, run, with_native};

/// How long a job may take for one thing on a busy machine.
const PATIENCE: Duration = Duration::from_secs(240);

/// What is durable of a run. None of it ever gets smaller.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Progress {
    /// Updates that the newest checkpoint holds.
    pub(super) updates: u64,
    /// Steps ever inserted into each replay-server's store, in the order of their folders.
    pub(super) inserted: Vec<u64>,
    /// Next sequence number of every actor, over all stores.
    pub(super) actors: BTreeMap<String, u64>,
}

/// A run and its job.
#[derive(Debug)]
pub(super) struct Run<'a> {
    pub(super) binary: &'a Path,
    pub(super) root: &'a Path,
    pub(super) dir: PathBuf,
    pub(super) job: String,
    last: Progress,
}

impl<'a> Run<'a> {
    pub(super) fn new(binary: &'a Path, root: &'a Path, dir: PathBuf, job: String) -> Self {
        Self {
            binary,
            root,
            dir,
            job,
            last: Progress::default(),
        }
    }

    /// What is durable now.
    ///
    /// # Errors
    /// Where anything is less than when this was asked last.
    pub(super) fn progress(&mut self) -> Result<Progress> {
        let now = Progress {
            updates: self.newest_checkpoint(),
            ..self.stores()?
        };
        let last = &self.last;
        let steps_kept = last.inserted.iter().enumerate();
        let kept = now.updates >= last.updates && { steps_kept }
            .all(|(shard, steps)| now.inserted.get(shard) >= Some(steps));
        ensure!(kept, "the run went back, from {last:?} to {now:?}");
        self.last.clone_from(&now);
        Ok(now)
    }

    /// Waits until the run has more updates, and every store more steps, than now.
    pub(super) fn goes_on(&mut self, cluster: &Cluster) -> Result<Progress> {
        let before = self.progress()?;
        until("the run goes on", || {
            let job = cluster.job(&self.job)?;
            ensure!(
                ["RUNNING", "PENDING", "COMPLETING"].contains(&job.state()),
                "job {} ended as {}; with more --env-frames it has more time",
                self.job,
                job.state()
            );
            let now = self.progress()?;
            let steps = |progress: &Progress| progress.inserted.iter().sum::<u64>();
            let more = now.updates > before.updates && steps(&now) > steps(&before);
            Ok(more.then_some(now))
        })
    }

    /// The process of a role, by words of its command line.
    pub(super) fn process(&self, words: &[&str]) -> Option<u32> {
        let binary = self.binary.to_string_lossy();
        command_lines().find_map(|(pid, line)| {
            let args: Vec<&str> = line.split('\0').collect();
            let all = args.first() == Some(&binary.as_ref())
                && words.iter().all(|word| args.contains(word));
            all.then_some(pid)
        })
    }

    /// Kills a role as nothing can that it could handle, and waits for its successor.
    pub(super) fn kill(&self, words: &[&str]) -> Result<()> {
        let missing = || format!("no process has {} in its command line", words.join(" "));
        let pid = self.process(words).with_context(missing)?;
        run(Command::new("kill").args(["-KILL", &pid.to_string()]))?;
        until(&format!("{} comes back", words[0]), || {
            Ok(self.process(words).filter(|new| *new != pid).map(drop))
        })
    }

    /// The line by which the roles find each other: replay-servers, learner, folder of secrets.
    pub(super) fn addresses(&self) -> Result<Vec<String>> {
        let path = self.dir.join("addresses");
        let line = fs::read_to_string(&path).with_context(|| format!("no {}", path.display()))?;
        Ok(line.split_whitespace().map(str::to_owned).collect())
    }

    /// The binary, asked something.
    pub(super) fn ask<'b>(&self, args: impl IntoIterator<Item = &'b str>) -> Command {
        let mut command = Command::new(self.binary);
        command.args(args);
        with_native(&mut command, self.root);
        command
    }

    /// The folders of the replay-servers.
    pub(super) fn shards(&self) -> Vec<PathBuf> {
        (0..)
            .map(|shard: usize| self.dir.join(format!("replay/{shard}")))
            .take_while(|dir| dir.exists())
            .collect()
    }

    fn newest_checkpoint(&self) -> u64 {
        // No folder and no number both mean: none yet.
        let entries = fs::read_dir(self.dir.join("checkpoints"));
        let names = entries.into_iter().flatten().flatten();
        names
            .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
            .max()
            .unwrap_or(0)
    }

    fn stores(&self) -> Result<Progress> {
        let mut found = Progress::default();
        for dir in self.shards() {
            if !dir.join("ID").exists() {
                // Not opened for the first time yet.
                found.inserted.push(0);
                continue;
            }
            let mut inspect = self.ask(["replay", "inspect", "--json"]);
            let store: Value = serde_json::from_slice(&output(inspect.arg(&dir))?)?;
            let number = |value: &Value| value.as_u64().context("inspect prints no number");
            found.inserted.push(number(&store["inserted_steps"])?);
            for actor in store["actors"].as_array().into_iter().flatten() {
                let id = actor["actor_id"].as_str().context("an actor has no id")?;
                *found.actors.entry(id.to_owned()).or_default() += number(&actor["next_seq"])?;
            }
        }
        Ok(found)
    }
}

/// Waits until a job is in one of `states`.
pub(super) fn until_job(cluster: &Cluster, id: &str, states: &[&str]) -> Result<Job> {
    until(&format!("job {id} is {}", states.join(" or ")), || {
        let job = cluster.job(id)?;
        let failed = ["FAILED", "CANCELLED", "TIMEOUT"].contains(&job.state());
        if failed && !states.contains(&job.state()) {
            bail!("job {id} ended as {}", job.state());
        }
        Ok(states.contains(&job.state()).then_some(job))
    })
}

/// Asks twice a second until there is an answer.
///
/// # Errors
/// Where there is none within [`PATIENCE`].
pub(super) fn until<T>(what: &str, mut ask: impl FnMut() -> Result<Option<T>>) -> Result<T> {
    let start = Instant::now();
    while start.elapsed() < PATIENCE {
        if let Some(answer) = ask().with_context(|| format!("waiting until {what}"))? {
            return Ok(answer);
        }
        sleep(Duration::from_millis(500));
    }
    bail!("waited {} s in vain until {what}", PATIENCE.as_secs())
}

/// Command lines of all processes of this machine, their arguments separated by NUL.
pub(super) fn command_lines() -> impl Iterator<Item = (u32, String)> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| {
        let pid = entry.file_name().to_str()?.parse().ok()?;
        // A process may end meanwhile.
        let line = fs::read(entry.path().join("cmdline")).ok()?;
        Some((pid, String::from_utf8_lossy(&line).into_owned()))
    })
}
