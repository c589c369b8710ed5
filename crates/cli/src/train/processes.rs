//! The roles as child processes: started, restarted when they die, and never left behind.

use std::fs::OpenOptions;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use backon::{BackoffBuilder, ExponentialBuilder};
use tokio::process::{Child, Command};

/// A role that dies sooner than this was not able to start.
const EARLY: Duration = Duration::from_secs(5);

/// Deaths that count. A role that dies again and again will not get better.
const DEATH_WINDOW: Duration = Duration::from_secs(600);

/// Pauses before restarts, one for each death within [`DEATH_WINDOW`] that is put up with.
const RESTARTS: ExponentialBuilder = ExponentialBuilder::new()
    .with_min_delay(Duration::from_millis(500))
    .with_max_delay(Duration::from_secs(5))
    .with_max_times(5);

/// How long roles may take to stop by themselves before they are killed. All of them together stay under ten
/// seconds.
const STOP_DEADLINE: Duration = Duration::from_secs(6);
const REPLAY_STOP_DEADLINE: Duration = Duration::from_secs(3);

/// One role.
#[derive(Debug)]
pub(crate) struct Process {
    name: String,
    args: Vec<String>,
    state: State,
    /// When it ended without being asked to, the newest last.
    deaths: Vec<Instant>,
    started_well: bool,
    /// Where this start's lines begin in the log.
    log_offset: u64,
}

#[derive(Debug)]
enum State {
    /// To be started at this time.
    Due(Instant),
    /// Runs since this time. Dropping the child kills it.
    Running(Child, Instant),
    /// Ended by itself, without an error.
    Finished,
}

/// All roles of a run, in the order of their start.
#[derive(Debug)]
pub(crate) struct Processes {
    processes: Vec<Process>,
    logs: PathBuf,
}

impl Process {
    pub(crate) fn new(name: &str, args: Vec<String>) -> Self {
        Self {
            name: name.to_owned(),
            args,
            state: State::Due(Instant::now()),
            deaths: Vec::new(),
            started_well: false,
            log_offset: 0,
        }
    }

    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// What the supervisor has to say of it; nothing if it simply runs.
    pub(crate) fn trouble(&self) -> Option<String> {
        match (&self.state, self.deaths.len()) {
            (State::Running(..), 0) => None,
            (State::Running(..), deaths) => Some(format!("restarted {deaths} times")),
            (State::Due(_), 0) => Some("starting".into()),
            (State::Due(_), _) => Some("restarting".into()),
            (State::Finished, _) => Some("finished".into()),
        }
    }

    fn start(&mut self, logs: &Path) -> anyhow::Result<()> {
        let path = self.log(logs);
        let log = OpenOptions::new()
            .create(true)
            .append(true)
            .open(&path)
            .with_context(|| format!("cannot open {}", path.display()))?;
        self.log_offset = log.metadata().map_or(0, |metadata| metadata.len());
        let program = std::env::current_exe().context("this program has no path")?;
        let child = Command::new(program)
            .args(&self.args)
            // Spinning threads of several processes on few cores slow each other down tenfold.
            .env("OMP_WAIT_POLICY", "PASSIVE")
            // The role stops when this end of the pipe closes, also if the supervisor is killed.
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(log)
            // Ctrl-C reaches the supervisor alone, which stops the roles in order.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .with_context(|| format!("cannot start {}", self.name))?;
        self.state = State::Running(child, Instant::now());
        Ok(())
    }

    /// Notices an end and decides what follows. Only the learner may end by itself; a role that somebody else
    /// told to stop is started again.
    fn ended(&mut self, status: ExitStatus, lived: Duration, logs: &Path) -> anyhow::Result<()> {
        if status.success() && self.name == "learner" {
            self.state = State::Finished;
            return Ok(());
        }
        let now = Instant::now();
        self.deaths.retain(|at| now - *at < DEATH_WINDOW);
        self.deaths.push(now);
        let unable = !status.success() && lived < EARLY && !self.started_well;
        let pause = RESTARTS.build().nth(self.deaths.len() - 1);
        let Some(pause) = pause.filter(|_| !unable) else {
            bail!("{} failed: {}", self.name, self.last_words(status, logs));
        };
        tracing::warn!(role = self.name, %status, pause_ms = pause.as_millis() as u64, "restarting");
        self.state = State::Due(now + pause);
        Ok(())
    }

    fn log(&self, logs: &Path) -> PathBuf {
        logs.join(format!("{}.log", self.name))
    }

    /// The error a role ended with, or where to look for it.
    fn last_words(&self, status: ExitStatus, logs: &Path) -> String {
        let path = self.log(logs);
        let bytes = std::fs::read(&path).unwrap_or_default();
        let this_start = bytes.get(self.log_offset as usize..).unwrap_or_default();
        let text = String::from_utf8_lossy(this_start);
        let error = text
            .lines()
            .rev()
            .find_map(|line| line.strip_prefix("error: "));
        error.map_or_else(
            || format!("it ended with {status}; see {}", path.display()),
            str::to_owned,
        )
    }
}

impl Processes {
    pub(crate) fn new(run_dir: &Path) -> Self {
        Self {
            processes: Vec::new(),
            logs: run_dir.join("logs"),
        }
    }

    pub(crate) fn add(&mut self, process: Process) {
        self.processes.push(process);
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = &Process> {
        self.processes.iter()
    }

    pub(crate) fn finished(&self, name: &str) -> bool {
        self.processes
            .iter()
            .any(|p| p.name == name && matches!(p.state, State::Finished))
    }

    /// Starts what is due and notices what has ended.
    ///
    /// # Errors
    /// The words of a role that cannot start, or dies again and again.
    pub(crate) fn tend(&mut self) -> anyhow::Result<()> {
        for process in &mut self.processes {
            match &mut process.state {
                State::Due(at) if Instant::now() >= *at => process.start(&self.logs)?,
                State::Running(child, since) => {
                    let lived = since.elapsed();
                    let ended = child
                        .try_wait()
                        .with_context(|| format!("cannot watch {}", process.name))?;
                    process.started_well |= lived >= EARLY;
                    if let Some(status) = ended {
                        process.ended(status, lived, &self.logs)?;
                    }
                }
                State::Due(_) | State::Finished => {}
            }
        }
        Ok(())
    }

    /// Stops all roles: first those that use the replay-server, which flush and write a checkpoint, then it.
    pub(crate) async fn stop(&mut self) {
        let (replay, others): (Vec<&mut Process>, Vec<&mut Process>) = self
            .processes
            .iter_mut()
            .partition(|process| process.name == "replay");
        stop_all(others, STOP_DEADLINE).await;
        stop_all(replay, REPLAY_STOP_DEADLINE).await;
    }
}

async fn stop_all(processes: Vec<&mut Process>, deadline: Duration) {
    let mut running: Vec<(&str, &mut Child)> = processes
        .into_iter()
        .filter_map(|process| match &mut process.state {
            State::Running(child, _) => Some((process.name.as_str(), child)),
            _ => None,
        })
        .collect();
    for (_, child) in &mut running {
        drop(child.stdin.take());
    }
    let until = tokio::time::Instant::now() + deadline;
    for (name, child) in running {
        if tokio::time::timeout_at(until, child.wait()).await.is_err() {
            tracing::warn!(role = name, "did not stop in time and is killed");
            if let Err(error) = child.kill().await {
                tracing::warn!(role = name, %error, "cannot be killed");
            }
        }
    }
}
