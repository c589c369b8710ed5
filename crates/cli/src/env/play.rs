//! `isodream env play`: an episode to look at.

use std::cell::RefCell;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use isodream_actor::AgentPolicy;
use isodream_actor::rollout::{Outcome, Pilot, episode};
use isodream_envs::{Environment, ScriptedDriver, Statistics, steps_per_s};
use isodream_learner::checkpoint::Checkpoint;
use isodream_model::Actions;
use isodream_rpc::Role;
use isodream_telemetry::{Rgb, write_gif, write_mp4};

use super::{env_config, open};
use crate::output::print;
use crate::security::ClientArgs;

/// Columns of a contact sheet.
const COLUMNS: usize = 8;
/// Pictures of a contact sheet at most.
const PICTURES: usize = 48;

/// Options of `isodream env play`.
#[derive(Debug, Args)]
pub(crate) struct PlayArgs {
    /// Id of the environment, as `isodream env list` names them
    id: String,
    /// `random`, a scripted driver (`keep_lane`, `reacting`, ..) or `checkpoint`
    #[arg(long, default_value = "random")]
    policy: String,
    /// A run directory or a checkpoint folder, for the policy `checkpoint`
    #[arg(long, required_if_eq("policy", "checkpoint"))]
    checkpoint: Option<PathBuf>,
    /// A video (.mp4), an animation (.gif) or a contact sheet (.png)
    #[arg(long)]
    out: PathBuf,
    /// Seed of the episode
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Agent steps at most
    #[arg(long)]
    steps: Option<u32>,
    /// Height and width of the pictures; a checkpoint has its own
    #[arg(long, default_value_t = 64)]
    size: usize,
    /// How often each pixel is repeated in both directions
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..))]
    magnify: u8,
    /// A setting of the environment, for example env.vehicles=10; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    security: ClientArgs,
}

/// Runs the command.
pub(super) fn run(args: &PlayArgs) -> anyhow::Result<()> {
    let kind = Kind::of(&args.out)?;
    let mut config = env_config(&args.id, &args.set)?;
    config.image_size = args.size;
    let checkpoint = match (&*args.policy, &args.checkpoint) {
        ("checkpoint", Some(path)) => Some(Checkpoint::find(path)?),
        _ => None,
    };
    if let Some(checkpoint) = &checkpoint {
        config.image_size = checkpoint.config.env.image_size;
    }
    let mut env = Statistics::new(open(&args.security.dialer(Role::Actor)?, &config)?);
    let (outcome, frames) = match &checkpoint {
        Some(checkpoint) => {
            let mut agent = AgentPolicy::new(&checkpoint.config, env.spec(), 1, &checkpoint.model)
                .with_context(|| format!("the checkpoint cannot act in {}", args.id))?;
            let mut pilot = Pilot::Agent(&mut agent, Actions::Mode);
            watch(&mut env, &mut pilot, args)?
        }
        None => {
            let mut driver = args.policy.parse::<ScriptedDriver>()?.driver(args.seed);
            let mut pilot = Pilot::Driver(driver.as_mut());
            watch(&mut env, &mut pilot, args)?
        }
    };
    let frames: Vec<Rgb> = frames
        .iter()
        .map(|frame| frame.upscale(args.magnify.into()))
        .collect();
    let frames_per_s = steps_per_s(&args.id, config.action_repeat);
    match kind {
        Kind::Video => write_mp4(&args.out, frames, frames_per_s)?,
        Kind::Animation => write_gif(&args.out, &frames, frames_per_s)?,
        Kind::Sheet => sheet(&frames).save_png(&args.out)?,
    }
    let end = outcome
        .end_reason
        .map_or_else(String::new, |reason| format!(", {reason}"));
    print(&format!(
        "{}: return {:.1} in {} steps{end}: {}",
        args.id,
        outcome.score,
        outcome.length,
        args.out.display()
    ))?;
    let metrics = outcome.metrics.iter();
    let metrics: Vec<_> = metrics
        .map(|(name, value)| format!("{name} {}", (value * 100.0).round() / 100.0))
        .collect();
    print(&metrics.join(", "))
}

/// What a file is to hold.
enum Kind {
    Video,
    Animation,
    Sheet,
}

impl Kind {
    fn of(path: &Path) -> anyhow::Result<Self> {
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("mp4") => Ok(Self::Video),
            Some("gif") => Ok(Self::Animation),
            Some("png") => Ok(Self::Sheet),
            _ => bail!(
                "--out {}: the name must end in .mp4, .gif or .png",
                path.display()
            ),
        }
    }
}

fn watch(
    env: &mut dyn Environment,
    pilot: &mut Pilot<'_>,
    args: &PlayArgs,
) -> anyhow::Result<(Outcome, Vec<Rgb>)> {
    let shape = env.spec().image;
    let frames = RefCell::new(Vec::new());
    // Asked before a moment's picture is taken, and the first picture is that of the reset.
    let go_on = || {
        let steps = frames.borrow().len();
        args.steps.is_none_or(|limit| steps < limit as usize)
    };
    let outcome = episode(env, pilot, args.seed, &go_on, &mut |moment| {
        let picture = Rgb::new(shape.width, shape.height, moment.step.image.clone());
        frames.borrow_mut().push(picture);
    })?;
    Ok((outcome, frames.into_inner()))
}

/// Pictures evenly spread over the episode, the first and the last among them.
fn sheet(frames: &[Rgb]) -> Rgb {
    let count = frames.len().min(PICTURES);
    let chosen: Vec<Rgb> = (0..count)
        .map(|index| frames[index * (frames.len() - 1) / count.saturating_sub(1).max(1)].clone())
        .collect();
    let rows: Vec<Vec<Rgb>> = chosen.chunks(COLUMNS).map(<[Rgb]>::to_vec).collect();
    Rgb::tile(&rows, 2)
}
