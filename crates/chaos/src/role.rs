//! A role as a process under a supervisor that starts it again when it ends, as a container engine does.

use std::fs::{self, File, OpenOptions};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use isodream_rpc::reconnect_delays;
use rustix::process::{Pid, Signal, kill_process};

use crate::interrupt;

/// How often the supervisor looks at its child.
const LOOK: Duration = Duration::from_millis(10);

/// A child that lived this long is started again without delay at its end.
const LIVED: Duration = Duration::from_secs(10);

/// How long SIGTERM may take.
pub(crate) const DRAIN: Duration = Duration::from_secs(25);

/// How a role is started.
#[derive(Debug, Clone)]
pub(crate) struct RoleSpec {
    /// Unique in the cluster.
    pub(crate) name: String,
    /// Program and arguments.
    pub(crate) command: Vec<String>,
    pub(crate) env: Vec<(String, String)>,
    /// Where its standard error goes, start after start.
    pub(crate) log: PathBuf,
}

/// A supervised role. Dropping it kills it.
#[derive(Debug)]
pub(crate) struct Role {
    shared: Arc<Mutex<Shared>>,
    supervisor: Option<JoinHandle<()>>,
    name: String,
    log: PathBuf,
}

#[derive(Debug)]
struct Shared {
    spec: RoleSpec,
    wanted: Wanted,
    child: Option<Child>,
    starts: u64,
    exits: Vec<ExitStatus>,
    trouble: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Wanted {
    Running,
    /// Not to be started again for now.
    Held,
    /// Never again.
    Ended,
}

impl Role {
    /// Starts the role and its supervisor.
    pub(crate) fn start(spec: RoleSpec) -> Result<Self> {
        let (name, log) = (spec.name.clone(), spec.log.clone());
        let shared = Arc::new(Mutex::new(Shared {
            spec,
            wanted: Wanted::Running,
            child: None,
            starts: 0,
            exits: Vec::new(),
            trouble: None,
        }));
        let supervised = shared.clone();
        let supervisor = std::thread::Builder::new()
            .name(format!("supervise {name}"))
            .spawn(move || supervise(&supervised))?;
        Ok(Self {
            shared,
            supervisor: Some(supervisor),
            name,
            log,
        })
    }

    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// The process that runs now, if one does.
    pub(crate) fn pid(&self) -> Option<u32> {
        self.lock().child.as_ref().map(Child::id)
    }

    /// How its processes ended so far.
    pub(crate) fn exits(&self) -> Vec<ExitStatus> {
        self.lock().exits.clone()
    }

    /// Why it cannot be started, if it cannot.
    pub(crate) fn trouble(&self) -> Option<String> {
        self.lock().trouble.clone()
    }

    /// Sends `signal` to the process that runs now. An error where none does.
    pub(crate) fn signal(&self, signal: Signal) -> Result<()> {
        // The supervisor reaps under the same lock, so that the id is still that of our child.
        let shared = self.lock();
        let Some(child) = &shared.child else {
            bail!("{} does not run", self.name);
        };
        let pid = Pid::from_child(child);
        kill_process(pid, signal).with_context(|| format!("cannot send a signal to {}", self.name))
    }

    /// `kill -9`, as soon as there is a process to kill. It is gone when this returns.
    pub(crate) fn kill(&self) -> Result<()> {
        let exits = interrupt::until(&format!("{} runs", self.name), DRAIN, || {
            let exits = self.exits().len();
            Ok(self.signal(Signal::KILL).is_ok().then_some(exits))
        })?;
        interrupt::until(&format!("{} is dead", self.name), DRAIN, || {
            Ok((self.exits().len() > exits).then_some(()))
        })
    }

    /// Lets nobody start it again until [`Role::release`].
    pub(crate) fn hold(&self) {
        self.lock().wanted = Wanted::Held;
    }

    /// Starts it again where it was held, from now on with `change` made to how it is started.
    pub(crate) fn release(&self, change: impl FnOnce(&mut RoleSpec)) {
        let mut shared = self.lock();
        change(&mut shared.spec);
        shared.wanted = Wanted::Running;
    }

    /// Tells it to stop, and says how long that took and how it ended.
    pub(crate) fn stop(&self) -> Result<(Duration, Option<ExitStatus>)> {
        self.lock().wanted = Wanted::Ended;
        let begun = Instant::now();
        if self.signal(Signal::TERM).is_err() {
            return Ok((Duration::ZERO, None));
        }
        interrupt::until(&format!("{} drains", self.name), DRAIN, || {
            Ok(self.pid().is_none().then_some(()))
        })?;
        Ok((begun.elapsed(), self.exits().last().copied()))
    }

    /// Length of its log in bytes.
    pub(crate) fn log_end(&self) -> u64 {
        fs::metadata(&self.log).map_or(0, |metadata| metadata.len())
    }

    /// Its log from byte `start` on.
    pub(crate) fn log_since(&self, start: u64) -> Result<String> {
        let bytes =
            fs::read(&self.log).with_context(|| format!("cannot read {}", self.log.display()))?;
        let new = bytes.get(start as usize..).unwrap_or_default();
        Ok(String::from_utf8_lossy(new).into_owned())
    }

    fn lock(&self) -> MutexGuard<'_, Shared> {
        lock(&self.shared)
    }
}

impl Drop for Role {
    fn drop(&mut self) {
        {
            let mut shared = self.lock();
            shared.wanted = Wanted::Ended;
            if let Some(child) = &mut shared.child {
                // It may have ended by itself.
                let _ = child.kill();
            }
        }
        if let Some(supervisor) = self.supervisor.take() {
            let _ = supervisor.join();
        }
    }
}

fn lock(shared: &Mutex<Shared>) -> MutexGuard<'_, Shared> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Keeps one child running until the role is not wanted any more.
fn supervise(shared: &Mutex<Shared>) {
    let mut delays = reconnect_delays();
    let (mut started, mut due) = (Instant::now(), Instant::now());
    loop {
        {
            let mut shared = lock(shared);
            let ended = match &mut shared.child {
                Some(child) => child.try_wait().ok().flatten(),
                None => None,
            };
            if let Some(status) = ended {
                shared.child = None;
                shared.exits.push(status);
                if started.elapsed() > LIVED {
                    delays = reconnect_delays();
                }
                due = Instant::now() + delays.next().unwrap_or_default();
            }
            match (shared.wanted, &shared.child) {
                (Wanted::Ended, None) => return,
                (Wanted::Running, None) if Instant::now() >= due => {
                    started = Instant::now();
                    match spawn(&shared.spec) {
                        Ok(child) => shared.child = Some(child),
                        Err(error) => {
                            shared.trouble = Some(format!("{error:#}"));
                            due = Instant::now() + delays.next().unwrap_or_default();
                        }
                    }
                    shared.starts += 1;
                }
                _ => {}
            }
        }
        std::thread::sleep(LOOK);
    }
}

fn spawn(spec: &RoleSpec) -> Result<Child> {
    let log: File = OpenOptions::new()
        .create(true)
        .append(true)
        .open(&spec.log)
        .with_context(|| format!("cannot open {}", spec.log.display()))?;
    let (program, args) = spec
        .command
        .split_first()
        .context("a role has no program")?;
    Command::new(program)
        .args(args)
        .envs(spec.env.iter().cloned())
        // Spinning threads of several processes on few cores slow each other down tenfold.
        .env("OMP_WAIT_POLICY", "PASSIVE")
        // The role stops when this end of the pipe closes, also if this program is killed.
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(log)
        .spawn()
        .with_context(|| format!("cannot start {}", spec.name))
}
