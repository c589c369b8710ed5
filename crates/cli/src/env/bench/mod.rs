//! `isodream env bench`: frames per second with a picture each, simulator steps per second without, and what more
//! cores and more environments bring and cost.

mod many;

use std::num::NonZeroUsize;
#[cfg(feature = "mujoco")]
use std::path::PathBuf;
use std::thread::available_parallelism;
use std::time::Instant;

use anyhow::ensure;
use clap::Args;
#[cfg(feature = "mujoco")]
use isodream_envs::dmc::parity::Peer;
use isodream_envs::{RandomDriver, ScriptedDriver, ids};
use isodream_rpc::{Role, remote_address};
use serde::Serialize;

use super::{env_config, open};
use crate::output::{print, print_json};
use crate::security::ClientArgs;

/// Simulator steps between two pictures where pictures are not to count.
const BLIND_REPEAT: u32 = 200;

/// Options of `isodream env bench`.
#[derive(Debug, Args)]
pub(crate) struct BenchArgs {
    /// Ids of environments; all by default
    ids: Vec<String>,
    /// Seconds spent on each measurement
    #[arg(long, default_value_t = 1.0)]
    seconds: f64,
    /// A folder for Python with dm_control, which is measured as well where there is software OpenGL for it
    /// (Debian: libosmesa6)
    #[cfg(feature = "mujoco")]
    #[arg(long)]
    peer: Option<PathBuf>,
    /// Threads of the vectorised measurement; all cores by default
    #[arg(long)]
    threads: Option<NonZeroUsize>,
    /// A setting of the environments, for example env.vehicles=10; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print what one more environment takes, in MB, and nothing else
    #[arg(long, hide = true)]
    memory: bool,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    security: ClientArgs,
}

/// One environment on one core, and a batch of them on several.
#[derive(Debug, Serialize)]
struct EnvBench {
    id: String,
    /// Simulator steps with a picture each.
    frames_per_s: f64,
    /// Simulator steps without pictures.
    steps_per_s: f64,
    /// The reference implementation's `frames_per_s`, where it was measured in the same run.
    peer_frames_per_s: Option<f64>,
    /// Threads of the batch.
    threads: usize,
    /// The batch's frames per second with all threads, over those with one; none for another process.
    vector_speedup: Option<f64>,
    /// What one more environment adds to this process, in MB; none where the system does not tell.
    mb_per_environment: Option<f64>,
}

/// Runs the command.
pub(super) fn run(args: &BenchArgs) -> anyhow::Result<()> {
    ensure!(
        args.seconds > 0.0,
        "--seconds {}: must be above 0",
        args.seconds
    );
    let chosen: Vec<String> = if args.ids.is_empty() {
        ids().iter().map(|id| (*id).to_owned()).collect()
    } else {
        args.ids.clone()
    };
    if args.memory {
        for id in chosen {
            if let Some(mb) = many::measure_mb(&env_config(&id, &args.set)?)? {
                print(&mb.to_string())?;
            }
        }
        return Ok(());
    }
    let threads = args.threads.map_or_else(available_parallelism, Ok)?;
    if args.json {
        let results = chosen.into_iter().map(|id| measure(id, threads, args));
        return print_json(&results.collect::<anyhow::Result<Vec<_>>>()?);
    }
    // All environments take minutes: each is shown as soon as it is measured.
    let width = chosen.iter().map(String::len).max().unwrap_or(0);
    print(&format!(
        "{:<width$} {:>10} {:>10} {:>8} {:>8} {:>8}",
        "id", "frames/s", "steps/s", "peer", "speedup", "MB each"
    ))?;
    for id in chosen {
        print(&row(&measure(id, threads, args)?, width))?;
    }
    Ok(())
}

fn measure(id: String, threads: NonZeroUsize, args: &BenchArgs) -> anyhow::Result<EnvBench> {
    let config = env_config(&id, &args.set)?;
    let (mut vector_speedup, mut mb_per_environment) = (None, None);
    if remote_address(&id).is_none() {
        mb_per_environment = many::mb_per_environment(&id, &args.set)?;
        vector_speedup = Some(many::speedup(&config, threads, args.seconds)?);
    }
    Ok(EnvBench {
        threads: threads.get(),
        vector_speedup,
        mb_per_environment,
        frames_per_s: rate(&id, 1, args)?,
        steps_per_s: rate(&id, BLIND_REPEAT, args)?,
        #[cfg(feature = "mujoco")]
        peer_frames_per_s: peer_rate(&id, args)?,
        #[cfg(not(feature = "mujoco"))]
        peer_frames_per_s: None,
        id,
    })
}

/// What dm_control makes of the same task, if it is to be measured and can be.
#[cfg(feature = "mujoco")]
fn peer_rate(id: &str, args: &BenchArgs) -> anyhow::Result<Option<f64>> {
    match (&args.peer, id.strip_prefix("dmc/")) {
        (Some(folder), Some(task)) if !task.contains('/') => {
            Ok(Peer::install(folder)?.frames_per_s(task, args.seconds)?)
        }
        _ => Ok(None),
    }
}

/// Simulator steps per second with a picture for every `repeat` of them.
fn rate(id: &str, repeat: u32, args: &BenchArgs) -> anyhow::Result<f64> {
    let mut config = env_config(id, &args.set)?;
    config.action_repeat = repeat;
    config.time_limit = u32::MAX;
    let mut env = open(&args.security.dialer(Role::Actor)?, &config)?;
    let mut seed = 0;
    env.reset(seed)?;
    // Random driving soon leaves the road, and resets would be measured.
    let mut driver = match env.privileged() {
        Some(_) => ScriptedDriver::KeepLane.driver(seed),
        None => Box::new(RandomDriver::new(seed)),
    };
    let (mut steps, mut seconds) = (0_u64, 0.0);
    while seconds < args.seconds {
        let action = driver.act(env.as_ref())?;
        let begun = Instant::now();
        let is_last = env.step(&action)?.is_last;
        seconds += begun.elapsed().as_secs_f64();
        // A remote one has its own.
        steps += u64::from(env.spec().action_repeat);
        if is_last {
            seed += 1;
            env.reset(seed)?;
        }
    }
    Ok(steps as f64 / seconds)
}

fn row(result: &EnvBench, width: usize) -> String {
    let known = |value: Option<f64>, decimals: usize| {
        value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
    };
    format!(
        "{:<width$} {:>10.0} {:>10.0} {:>8} {:>8} {:>8}",
        result.id,
        result.frames_per_s,
        result.steps_per_s,
        known(result.peer_frames_per_s, 0),
        known(result.vector_speedup, 2),
        known(result.mb_per_environment, 1)
    )
}
