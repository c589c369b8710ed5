//! The processes of the benchmark: this very program, started with a hidden command, told what to do line by line.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};
use isodream_core::config::EnvConfig;
use isodream_core::{EnvSpec, Steps};
use isodream_proto::Identity;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::{sampler, server, writer};
use crate::bench::frames;
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

    /// What the sequences are of: the environment's pictures, beside as many actions as the benchmark wants.
    pub(super) fn spec(&self) -> anyhow::Result<EnvSpec> {
        let spec = isodream_envs::spec(&self.env()).context("--environment")?;
        Ok(EnvSpec {
            action_dim: self.action_dim,
            ..spec
        })
    }

    /// The episodes that are written.
    pub(super) fn record(&self) -> anyhow::Result<Vec<Steps>> {
        frames::episodes(
            &self.env(),
            self.action_dim,
            self.episodes,
            self.episode_steps,
        )
    }

    fn env(&self) -> EnvConfig {
        let control = self.environment.starts_with("dmc/");
        EnvConfig {
            id: self.environment.clone(),
            image_size: self.image_size,
            action_repeat: if control { 2 } else { 4 },
            time_limit: self.episode_steps as u32 + 1,
            ..EnvConfig::default()
        }
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
pub(in crate::bench) fn answer<T: Serialize>(
    ready: &impl Serialize,
    mut asked: impl FnMut(&str) -> anyhow::Result<T>,
) -> anyhow::Result<()> {
    print(&serde_json::to_string(ready)?)?;
    for line in std::io::stdin().lines() {
        print(&serde_json::to_string(&asked(line?.trim())?)?)?;
    }
    Ok(())
}

/// A running part; it ends when this is dropped.
pub(in crate::bench) struct Part {
    child: Child,
    input: Option<ChildStdin>,
    output: BufReader<ChildStdout>,
}

impl Part {
    pub(super) fn start(role: Role, work: &Work) -> anyhow::Result<Self> {
        let role = role.to_possible_value().context("a role has no name")?;
        Self::spawn(&["replay-part", "--role", role.get_name()], work)
    }

    /// Starts a hidden command of `isodream bench` that takes its `work` as JSON.
    pub(in crate::bench) fn spawn(command: &[&str], work: &impl Serialize) -> anyhow::Result<Self> {
        let mut child = Command::new(std::env::current_exe()?)
            .arg("bench")
            .args(command)
            .arg("--work")
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

    pub(in crate::bench) fn id(&self) -> u32 {
        self.child.id()
    }

    pub(in crate::bench) fn ask(&mut self, question: &str) -> anyhow::Result<()> {
        let input = self.input.as_mut().context("a process has no input")?;
        writeln!(input, "{question}").context("a process of the benchmark ended")
    }

    pub(in crate::bench) fn hear<T: DeserializeOwned>(&mut self) -> anyhow::Result<T> {
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
