//! `isodream env verify`: the same states, rewards and pictures as in dm_control, and traffic without collisions.

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Args;
use isodream_envs::dmc::ids;
use isodream_envs::dmc::parity::{Parity, Peer, PictureParity, Plan};
use isodream_envs::traffic_without_collisions;
use isodream_telemetry::Rgb;
use serde::Serialize;

use crate::output::print_result;

/// States whose pictures are compared.
const PICTURES: usize = 40;
/// How many of them are shown.
const SHOWN: usize = 8;
/// Height and width of each.
const SIDE: usize = 64;
/// Cars of the paper's setup.
const VEHICLES: u32 = 30;

/// Greatest mean difference of pictures, of 255.
const MAX_PIXEL_DIFF: f64 = 1.5;
/// Least agreement of the chroma keys.
const MIN_MASK_AGREEMENT: f64 = 0.995;
/// Greatest difference of states and rewards.
const MAX_DIFF: f64 = 1e-9;

/// Options of `isodream env verify`.
#[derive(Debug, Args)]
pub(crate) struct VerifyArgs {
    /// Names of tasks, such as walker_walk; all by default
    tasks: Vec<String>,
    /// A folder for Python with dm_control, which is installed there unless it is there
    #[arg(long, default_value = ".native/dm_control")]
    peer: PathBuf,
    /// Hours that the highway's traffic is simulated without an ego
    #[arg(long, default_value_t = 1.0)]
    traffic_hours: f64,
    /// A folder for pictures of both, ours above dm_control's
    #[arg(long)]
    pictures: Option<PathBuf>,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Verification {
    tasks: Vec<TaskParity>,
    traffic_hours: f64,
    traffic_collision: bool,
}

/// Three episodes of 1,000 control steps, and 40 pictures.
#[derive(Debug, Serialize)]
struct TaskParity {
    id: &'static str,
    max_abs_state_diff: f64,
    max_abs_reward_diff: f64,
    /// Mean absolute difference of pictures, of 255; none without OSMesa, or where a task places a target.
    pixel_mad: Option<f64>,
    mask_agreement: Option<f64>,
}

impl TaskParity {
    fn new(numbers: &Parity, pictures: Option<&PictureParity>) -> Self {
        Self {
            id: numbers.id,
            max_abs_state_diff: numbers.max_abs_state_diff,
            max_abs_reward_diff: numbers.max_abs_reward_diff,
            pixel_mad: pictures.map(|p| p.mean_abs_diff),
            mask_agreement: pictures.map(|p| p.mask_agreement),
        }
    }

    fn holds(&self) -> bool {
        self.max_abs_state_diff <= MAX_DIFF
            && self.max_abs_reward_diff <= MAX_DIFF
            && self.pixel_mad.is_none_or(|mad| mad < MAX_PIXEL_DIFF)
            && self
                .mask_agreement
                .is_none_or(|share| share >= MIN_MASK_AGREEMENT)
    }
}

/// Runs the command.
pub(super) fn run(args: &VerifyArgs) -> anyhow::Result<()> {
    let tasks: Vec<&str> = if args.tasks.is_empty() {
        ids().collect()
    } else {
        args.tasks.iter().map(String::as_str).collect()
    };
    if let Some(folder) = &args.pictures {
        fs::create_dir_all(folder)
            .with_context(|| format!("cannot create {}", folder.display()))?;
    }
    let peer = Peer::install(&args.peer)?;
    let mut results = Vec::new();
    for numbers in peer.compare(&tasks, Plan::FULL)? {
        let pictures = peer.compare_pictures(numbers.id, PICTURES)?;
        if let (Some(folder), Some(pictures)) = (&args.pictures, &pictures) {
            let path = folder.join(format!("{}.png", numbers.id));
            side_by_side(pictures).save_png(&path)?;
        }
        results.push(TaskParity::new(&numbers, pictures.as_ref()));
    }
    let traffic = traffic_without_collisions(args.traffic_hours, VEHICLES, 0)?;
    let result = Verification {
        tasks: results,
        traffic_hours: traffic.hours,
        traffic_collision: traffic.collision.is_some(),
    };
    print_result(&result, args.json, Verification::table)?;
    let failed: Vec<&str> = result
        .tasks
        .iter()
        .filter(|task| !task.holds())
        .map(|task| task.id)
        .collect();
    ensure!(
        failed.is_empty(),
        "not as dm_control: {}",
        failed.join(", ")
    );
    ensure!(
        !result.traffic_collision,
        "two cars of the traffic collided"
    );
    Ok(())
}

/// Some of the pictures, ours in the upper row.
fn side_by_side(pictures: &PictureParity) -> Rgb {
    let row = |bytes: &[u8]| {
        let frames = bytes.chunks_exact(SIDE * SIDE * 3);
        let shown = frames.step_by(PICTURES / SHOWN).take(SHOWN);
        shown
            .map(|frame| Rgb::new(SIDE, SIDE, frame.to_vec()).upscale(2))
            .collect()
    };
    Rgb::tile(&[row(&pictures.ours), row(&pictures.theirs)], 2)
}

impl Verification {
    fn table(&self) -> String {
        let mut lines = vec![format!(
            "{:<24} {:>10} {:>10} {:>10} {:>10}",
            "task", "states", "rewards", "pixels", "mask"
        )];
        let or_dash = |value: Option<f64>, digits: usize| {
            value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
        };
        lines.extend(self.tasks.iter().map(|task| {
            format!(
                "{:<24} {:>10.1e} {:>10.1e} {:>10} {:>10}",
                task.id,
                task.max_abs_state_diff,
                task.max_abs_reward_diff,
                or_dash(task.pixel_mad, 2),
                or_dash(task.mask_agreement, 4)
            )
        }));
        let collision = if self.traffic_collision {
            "a collision ended it"
        } else {
            "no collision"
        };
        lines.push(format!(
            "traffic: {:.1} simulated hours, {collision}",
            self.traffic_hours
        ));
        lines.join("\n")
    }
}
