//! A run inside the cluster, seen from outside: its job, its folder, its processes.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

use super::cluster::{Cluster, address, node_name};
use super::drill::Subject;
use super::progress::{Position, Progress};
use crate::stage::{output, run, with_native};

/// How long a job may take for one thing on a busy machine.
const PATIENCE: Duration = Duration::from_secs(300);

/// A run and its job.
#[derive(Debug)]
pub(super) struct Run {
    binary: PathBuf,
    root: PathBuf,
    pub(super) dir: PathBuf,
    pub(super) job: String,
    last: Progress,
}

impl Run {
    /// A run in `dir` that is not submitted yet.
    pub(super) fn new(subject: &Subject, dir: PathBuf) -> Self {
        Self {
            binary: subject.binary.clone(),
            root: subject.root.clone(),
            dir,
            job: String::new(),
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
        ensure!(
            now.holds(last),
            "the run went back, from {last:?} to {now:?}"
        );
        self.last.clone_from(&now);
        Ok(now)
    }

    /// Waits until the run has a newer checkpoint and more steps than now.
    pub(super) fn goes_on(&mut self, cluster: &Cluster) -> Result<Progress> {
        let before = self.progress()?;
        until("the run goes on", || {
            let job = cluster.job(&self.job)?;
            ensure!(
                ["RUNNING", "PENDING", "COMPLETING"].contains(&job.state()),
                "job {} ended as {}; if it has COMPLETED too early, give it more --env-frames",
                self.job,
                job.state()
            );
            let now = self.progress()?;
            let more = now.updates > before.updates && now.steps() > before.steps();
            Ok(more.then_some(now))
        })
    }

    /// Waits until the job is COMPLETED, for as long as there are new checkpoints.
    pub(super) fn completes(&mut self, cluster: &Cluster) -> Result<Progress> {
        loop {
            let before = self.progress()?;
            let completed = until("the run goes on or is complete", || {
                let completed = is_in(cluster, &self.job, "COMPLETED")?;
                let now = self.progress()?;
                Ok((completed || now.updates > before.updates).then_some(completed))
            })?;
            if completed {
                return self.progress();
            }
        }
    }

    /// Waits until an actor has stored more than at the position `before`.
    pub(super) fn stores_from(&mut self, actor: &str, before: Position) -> Result<String> {
        until(&format!("steps of {actor} are stored"), || {
            let position = self.progress()?.position_of(actor);
            Ok((position > before).then(|| format!("{} chunks of {actor}", position.1)))
        })
    }

    /// Kills a role, known by words of its command line, and waits for its successor.
    pub(super) fn kill(&self, words: &[&str]) -> Result<String> {
        let find = || {
            self.processes().find_map(|(pid, line)| {
                let args: Vec<&str> = line.split('\0').collect();
                words.iter().all(|word| args.contains(word)).then_some(pid)
            })
        };
        let missing = || format!("no process has {} in its command line", words.join(" "));
        let pid = find().with_context(missing)?;
        run(Command::new("kill").args(["-KILL", &pid.to_string()]))?;
        let new = until(&format!("the {} comes back", words[0]), || {
            Ok(find().filter(|new| *new != pid))
        })?;
        Ok(format!("process {pid}, then {new}"))
    }

    /// Whether any role of the job runs; actors of other jobs, which joined it, do not count.
    pub(super) fn has_processes(&self) -> bool {
        let dir = self.dir.to_string_lossy();
        let names = ["actor", "evaluator"].map(|kind| format!("{kind}-{}", self.job));
        self.processes().any(|(_, line)| {
            let mut args = line.split('\0');
            args.any(|arg| {
                arg.starts_with(dir.as_ref()) || names.iter().any(|name| arg.starts_with(name))
            })
        })
    }

    /// Processes of the binary with their command lines.
    fn processes(&self) -> impl Iterator<Item = (u32, String)> {
        let binary = format!("{}\0", self.binary.display());
        command_lines().filter(move |(_, line)| line.starts_with(&binary))
    }

    /// Fails unless the addresses are those of `nodes`: a replay-server on each, the learner on the first.
    pub(super) fn is_placed_on(&self, nodes: [usize; 2]) -> Result<()> {
        let line = self.addresses()?;
        let [first, second] = nodes.map(address);
        let hosts: Vec<&str> = { line.split([' ', ',']).take(3) }
            .filter_map(|address| address.split(':').next())
            .collect();
        ensure!(
            hosts == [&first, &second, &first],
            "the roles are at {line}, not on {}",
            nodes.map(node_name).join(" and ")
        );
        Ok(())
    }

    /// Fails where others than the owner may read the secrets, or a token is an argument of any process.
    pub(super) fn keeps_its_secrets(&self) -> Result<String> {
        let line = self.addresses()?;
        let folder = line.trim().split(' ').nth(2);
        let folder = Path::new(folder.context("no folder of secrets among the addresses")?);
        let mode = fs::metadata(folder)?.permissions().mode() & 0o777;
        ensure!(mode == 0o700, "{} has mode {mode:o}", folder.display());
        for role in ["actor", "learner", "viewer"] {
            let path = folder.join(format!("{role}.token"));
            let token = fs::read_to_string(&path)
                .with_context(|| format!("cannot read {}", path.display()))?;
            let token = token.trim();
            ensure!(!token.is_empty(), "{} is empty", path.display());
            ensure!(
                !command_lines().any(|(_, line)| line.contains(token)),
                "the {role}'s token is on a command line"
            );
        }
        Ok(format!("mode {mode:o}"))
    }

    /// The line by which the roles find each other: replay-servers, learner, folder of secrets.
    pub(super) fn addresses(&self) -> Result<String> {
        let path = self.dir.join("addresses");
        fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))
    }

    /// The binary, asked something.
    pub(super) fn ask<'a>(&self, args: impl IntoIterator<Item = &'a str>) -> Command {
        let mut command = Command::new(&self.binary);
        command.args(args);
        with_native(&mut command, &self.root);
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
                let position = (number(&actor["epoch"])?, number(&actor["next_seq"])?);
                let newest = found.actors.entry(id.to_owned()).or_default();
                *newest = position.max(*newest);
            }
        }
        Ok(found)
    }
}

/// Waits until a job is in a state.
///
/// # Errors
/// Where it ends in another one.
pub(super) fn until_job(cluster: &Cluster, id: &str, state: &str) -> Result<()> {
    until(&format!("job {id} is {state}"), || {
        Ok(is_in(cluster, id, state)?.then_some(()))
    })
}

fn is_in(cluster: &Cluster, id: &str, state: &str) -> Result<bool> {
    let job = cluster.job(id)?;
    let over = ["COMPLETED", "FAILED", "CANCELLED", "TIMEOUT"].contains(&job.state());
    ensure!(
        !over || job.state() == state,
        "job {id} ended as {}",
        job.state()
    );
    Ok(job.state() == state)
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
fn command_lines() -> impl Iterator<Item = (u32, String)> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| {
        let pid = entry.file_name().to_str()?.parse().ok()?;
        // A process may end meanwhile.
        let line = fs::read(entry.path().join("cmdline")).ok()?;
        Some((pid, String::from_utf8_lossy(&line).into_owned()))
    })
}
