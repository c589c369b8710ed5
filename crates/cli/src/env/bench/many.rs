//! Batches of environments of this process: how they use several cores, and what they take.

use std::num::NonZeroUsize;
use std::process::{Command, Stdio};
use std::time::Instant;

use anyhow::{Context, ensure};
use isodream_core::config::EnvConfig;
use isodream_envs::{Driver, Environment, RandomDriver, VectorEnvironment, make};

/// Environments per thread: enough that no thread waits for the slowest one for long.
const PER_THREAD: usize = 4;
/// Turns of each thread count, of which the best counts. They alternate, so that a noisy moment does not fall on one of
/// them alone.
const TURNS: u32 = 5;
/// Environments that are made to see what one takes.
const SAMPLE: usize = 8;

/// Frames per second of a batch on `threads` threads over those of an equal one on a single thread; each turn takes
/// `seconds`.
pub(super) fn speedup(
    config: &EnvConfig,
    threads: NonZeroUsize,
    seconds: f64,
) -> anyhow::Result<f64> {
    let batch = |on: NonZeroUsize| -> anyhow::Result<VectorEnvironment> {
        let environments = (0..PER_THREAD * threads.get()).map(|_| make(config));
        let mut batch = VectorEnvironment::new(environments.collect::<Result<_, _>>()?, 0, on)?;
        batch.reset()?;
        Ok(batch)
    };
    let mut batches = [batch(NonZeroUsize::MIN)?, batch(threads)?];
    let mut random = RandomDriver::new(0);
    let mut rates = [0.0_f64; 2];
    for _ in 0..TURNS {
        for (batch, rate) in batches.iter_mut().zip(&mut rates) {
            *rate = steps_per_s(batch, &mut random, seconds)?.max(*rate);
        }
    }
    Ok(rates[1] / rates[0])
}

fn steps_per_s(
    batch: &mut VectorEnvironment,
    random: &mut RandomDriver,
    seconds: f64,
) -> anyhow::Result<f64> {
    let (mut steps, begun) = (0_u32, Instant::now());
    while begun.elapsed().as_secs_f64() < seconds {
        let mut actions = Vec::new();
        for index in 0..batch.len() {
            let env = batch.environment(index).context("an environment is gone")?;
            actions.extend(random.act(env)?);
        }
        batch.step(&actions)?;
        steps += 1;
    }
    Ok(f64::from(steps) / begun.elapsed().as_secs_f64())
}

/// What one more environment adds to a process, in MB; none where the system does not tell. Another process measures
/// it: in this one, memory that was freed is used again.
pub(super) fn mb_per_environment(id: &str, set: &[String]) -> anyhow::Result<Option<f64>> {
    let mut command = Command::new(std::env::current_exe()?);
    command.args(["env", "bench", id, "--memory"]);
    for setting in set {
        command.args(["--set", setting]);
    }
    let output = command.stderr(Stdio::inherit()).output()?;
    ensure!(
        output.status.success(),
        "measuring the memory of {id} failed"
    );
    let said = String::from_utf8(output.stdout)?;
    Ok(said.trim().parse().ok())
}

/// [`mb_per_environment`] in a process that did nothing else.
pub(super) fn measure_mb(config: &EnvConfig) -> anyhow::Result<Option<f64>> {
    let used = || -> anyhow::Result<Box<dyn Environment>> {
        let mut env = make(config)?;
        env.reset(0)?;
        Ok(env)
    };
    // What all of them share.
    let _first = used()?;
    let Some(before) = resident_mb() else {
        return Ok(None);
    };
    let _environments: Vec<_> = (0..SAMPLE).map(|_| used()).collect::<Result<_, _>>()?;
    Ok(resident_mb().map(|after| (after - before) / SAMPLE as f64))
}

/// Memory of this process that it shares with no other, in MB (Linux).
fn resident_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("RssAnon:"))?;
    let kib: f64 = line.trim().trim_end_matches("kB").trim().parse().ok()?;
    Some(kib * 1024.0 / 1e6)
}
