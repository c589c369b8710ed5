//! What the process-level tests share: roles as real processes, killed when they go out of scope, and the answers
//! they give over gRPC.

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use isodream_proto::v1;
use isodream_rpc::Dialer;

/// The `isodream` binary that `cargo xtask test` built beside this test.
///
/// # Errors
/// Where it is not there.
pub fn binary() -> Result<PathBuf> {
    let test = std::env::current_exe()?;
    let folder = test
        .parent()
        .and_then(Path::parent)
        .context("a test lies in target/PROFILE/deps")?;
    let binary = folder.join("isodream");
    if !binary.exists() {
        bail!("{} is not built; run cargo xtask test", binary.display());
    }
    Ok(binary)
}

/// Runs `isodream` with `args` to its end.
///
/// # Errors
/// Where it cannot be started.
pub fn isodream(args: &[&str]) -> Result<Output> {
    Ok(Command::new(binary()?)
        .args(args)
        .stdin(Stdio::null())
        .output()?)
}

/// A free loopback address.
///
/// # Errors
/// Where there is none.
pub fn free_address() -> Result<String> {
    Ok(TcpListener::bind("127.0.0.1:0")?.local_addr()?.to_string())
}

/// A running `isodream`, killed on drop.
#[derive(Debug)]
pub struct Running {
    child: Child,
}

impl Running {
    /// Starts `isodream`; its log goes to the test's output.
    ///
    /// # Errors
    /// Where it cannot be started.
    pub fn start(args: &[&str]) -> Result<Self> {
        let child = Command::new(binary()?)
            .args(args)
            .stdin(Stdio::null())
            .spawn()?;
        Ok(Self { child })
    }

    /// Its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Kills it at once, as `kill -9` does.
    ///
    /// # Errors
    /// Where it is gone already.
    pub fn kill(mut self) -> Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }

    /// Sends a signal by name, for example `INT`.
    ///
    /// # Errors
    /// Where it is gone already.
    pub fn signal(&self, name: &str) -> Result<()> {
        let status = Command::new("kill")
            .args(["-s", name, &self.id().to_string()])
            .status()?;
        if !status.success() {
            bail!("cannot send {name} to process {}", self.id());
        }
        Ok(())
    }

    /// Waits for its end.
    ///
    /// # Errors
    /// Where it still runs at the deadline.
    pub fn wait(&mut self, deadline: Duration) -> Result<ExitStatus> {
        until("the process ends", deadline, || {
            Ok(self.child.try_wait()?)
        })
    }

    /// Process ids of its children.
    ///
    /// # Errors
    /// Where `/proc` cannot be read.
    pub fn children(&self) -> Result<Vec<u32>> {
        let id = self.id();
        let text = std::fs::read_to_string(format!("/proc/{id}/task/{id}/children"))?;
        Ok(text
            .split_whitespace()
            .map(str::parse)
            .collect::<Result<_, _>>()?)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // Gone already in the good case.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Whether a process with this id runs (and is no zombie).
pub fn alive(id: u32) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
    stat.rsplit(')')
        .next()
        .is_some_and(|rest| !rest.is_empty() && !rest.trim_start().starts_with('Z'))
}

/// Asks again and again until there is an answer.
///
/// # Errors
/// At the deadline, or where asking itself fails.
pub fn until<T>(
    what: &str,
    deadline: Duration,
    mut ask: impl FnMut() -> Result<Option<T>>,
) -> Result<T> {
    let begun = Instant::now();
    while begun.elapsed() < deadline {
        if let Some(answer) = ask()? {
            return Ok(answer);
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    bail!("gave up after {deadline:?} waiting until {what}");
}

/// The learner's status; none while it is down.
///
/// # Errors
/// Where no runtime can be made.
pub fn learner_status(address: &str) -> Result<Option<v1::LearnerStatus>> {
    let runtime = tokio::runtime::Runtime::new()?;
    runtime.block_on(async {
        let mut client = Dialer::default().learner(address)?;
        Ok(client
            .status(v1::LearnerStatusRequest {})
            .await
            .ok()
            .map(|reply| reply.into_inner()))
    })
}

/// The replay-server's status; none while it is down.
///
/// # Errors
/// Where no runtime can be made.
pub fn replay_status(address: &str) -> Result<Option<v1::ReplayStatus>> {
    let runtime = tokio::runtime::Runtime::new()?;
    runtime.block_on(async {
        let mut client = Dialer::default().replay(address)?;
        Ok(client
            .status(v1::ReplayStatusRequest {})
            .await
            .ok()
            .map(|reply| reply.into_inner()))
    })
}
