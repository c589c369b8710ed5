//! The processes of the benchmark: this very program, started with a hidden command, told what to do line by line.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};
use isodream_core::EnvSpec;
use isodream_proto::Identity;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::{sampler, server, writer};
use crate::output::print;

/// What all processes have to know.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Work {
    pub(super) environment: String,
    pub(super) episodes: u64,
    pub(super) episode_steps: usize,
    pub(super) image_size: usize,
    pub(super) action_dim: usize,
    pub(super) chunk_steps: usize,
    pub(super) batch_size: usize,
    pub(super) batch_length: usize,
    pub(super) prefetch_batches: usize,
    pub(super) decoders: usize,
    pub(super) spool_chunks: usize,
    pub(super) segment_bytes: u64,
    /// Of the server; empty for the server itself.
    pub(super) address: String,
    pub(super) folder: std::path::PathBuf,
}

impl Work {
    /// Bytes of a raw step: picture, action and reward.
    pub(super) fn step_bytes(&self) -> usize {
        3 * self.image_size * self.image_size + 4 * self.action_dim + 4
    }

    pub(super) fn identity(&self, spec: &EnvSpec) -> Identity {
        Identity::new(spec, "")
    }
}

/// What a process does.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum Role {
    Server,
    Writer,
    Sampler,
}

/// Options of the hidden command.
#[derive(Debug, Args)]
pub(crate) struct PartArgs {
    #[arg(long, value_enum)]
    role: Role,
    /// `Work` as JSON
    #[arg(long)]
    work: String,
}

/// How much was done by a writer or a sampler.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct Done {
    pub(super) steps: u64,
    pub(super) seconds: f64,
    pub(super) cpu_seconds: f64,
}

/// Runs the hidden command.
pub(crate) fn run(args: &PartArgs) -> anyhow::Result<()> {
    let work: Work = serde_json::from_str(&args.work).context("--work")?;
    match args.role {
        Role::Server => server::run(&work),
        Role::Writer => writer::run(&work),
        Role::Sampler => sampler::run(&work),
    }
}

/// Answers every line of standard input, the first answer being without a question, until it ends.
pub(super) fn answer<T: Serialize>(
    ready: &impl Serialize,
    mut asked: impl FnMut(&str) -> anyhow::Result<T>,
) -> anyhow::Result<()> {
    print(&serde_json::to_string(ready)?);
    for line in std::io::stdin().lines() {
        print(&serde_json::to_string(&asked(line?.trim())?)?);
    }
    Ok(())
}

/// A running part; it ends when this is dropped.
pub(super) struct Part {
    child: Child,
    input: Option<ChildStdin>,
    output: BufReader<ChildStdout>,
}

impl Part {
    pub(super) fn start(role: Role, work: &Work) -> anyhow::Result<Self> {
        let role = role.to_possible_value().context("a role has no name")?;
        let mut child = Command::new(std::env::current_exe()?)
            .args(["bench", "replay-part", "--role", role.get_name(), "--work"])
            .arg(serde_json::to_string(work)?)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .context("cannot start a process of the benchmark")?;
        let input = child.stdin.take();
        let output = child.stdout.take().context("a process has no output")?;
        Ok(Self {
            child,
            input,
            output: BufReader::new(output),
        })
    }

    pub(super) fn ask(&mut self, question: &str) -> anyhow::Result<()> {
        let input = self.input.as_mut().context("a process has no input")?;
        writeln!(input, "{question}").context("a process of the benchmark ended")
    }

    pub(super) fn hear<T: DeserializeOwned>(&mut self) -> anyhow::Result<T> {
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        ensure!(!line.is_empty(), "a process of the benchmark ended");
        Ok(serde_json::from_str(&line)?)
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        self.input = None;
        let _ = self.child.wait();
    }
}
