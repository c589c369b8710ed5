//! The same seeds and actions here and in dm_control itself: how far apart do states and rewards come out?

mod pictures;
mod venv;

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::process::Command;

pub use self::pictures::PictureParity;
use self::venv::said;
use super::random::RandomState;
use super::{ControlError, ControlTask};
use crate::EnvError;

/// Drives dm_control and writes down what happens.
const SCRIPT: &str = include_str!("peer.py");

/// How long one action is held, here as in the script.
const HELD_STEPS: usize = 10;

/// Python with dm_control.
#[derive(Debug, Clone)]
pub struct Peer {
    python: PathBuf,
}

/// What both sides are asked to do with each task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Plan {
    /// Seeds the environment; the actions come from the next one.
    pub seed: u32,
    /// Resets of the same environment, each going on with its random numbers.
    pub episodes: usize,
    /// Control steps per episode, at most 1,000.
    pub steps: usize,
}

impl Plan {
    /// Three whole episodes, seeded so that even random actions earn something in nearly every task.
    pub const FULL: Self = Self {
        seed: 14,
        episodes: 3,
        steps: 1000,
    };
}

/// What came out for one task.
#[derive(Debug, Clone, PartialEq)]
pub struct Parity {
    /// Name of the task.
    pub id: &'static str,
    /// Greatest difference of any qpos or qvel after any reset or step; 0 is bit-identical, infinite is NaN.
    pub max_abs_state_diff: f64,
    /// Greatest difference of any reward; 0 is bit-identical, infinite is NaN.
    pub max_abs_reward_diff: f64,
    /// Greatest reward that was earned; where it is 0, the agreement of the rewards says little.
    pub best_reward: f64,
}

impl Peer {
    /// Finds dm_control in the virtual environment `folder`, or makes that with pip and the network.
    ///
    /// # Errors
    /// If Python or pip is missing or fails.
    pub fn install(folder: &Path) -> Result<Self, EnvError> {
        Ok(Self {
            python: venv::install(folder)?,
        })
    }

    /// Runs `plan` here and there for each of `tasks`.
    ///
    /// # Errors
    /// If a task is unknown or fails on either side.
    pub fn compare(&self, tasks: &[&str], plan: Plan) -> Result<Vec<Parity>, EnvError> {
        let mut ours = Vec::new();
        for id in tasks {
            ours.push(ControlTask::load(id)?);
        }
        let written = self.drive(&ours, plan)?;
        let mut theirs = written
            .chunks_exact(size_of::<f64>())
            .map(|bytes| f64::from_ne_bytes(bytes.try_into().unwrap_or_default()));
        let mut results = Vec::new();
        for task in &mut ours {
            results.push(follow(task, plan, &mut theirs)?);
        }
        match theirs.next() {
            None => Ok(results),
            Some(_) => Err(peer_error(&"more numbers than expected").into()),
        }
    }

    /// What dm_control makes of the same tasks.
    fn drive(&self, tasks: &[ControlTask], plan: Plan) -> Result<Vec<u8>, ControlError> {
        let mut command = Command::new(&self.python);
        command.args(["-c", SCRIPT]).args([
            plan.seed.to_string(),
            plan.episodes.to_string(),
            plan.steps.to_string(),
        ]);
        for task in tasks {
            let (domain, name) = task.domain_and_task();
            command.arg(format!("{domain}/{name}"));
        }
        // Nothing is drawn, and without a display the import alone would fail.
        command.env("MUJOCO_GL", "disable");
        let output = command.output().map_err(|error| peer_error(&error))?;
        if !output.status.success() {
            return Err(peer_error(&said(output.status, &output.stderr)));
        }
        Ok(output.stdout)
    }
}

/// Repeats with `task` what `theirs` tells of it.
fn follow(
    task: &mut ControlTask,
    plan: Plan,
    theirs: &mut impl Iterator<Item = f64>,
) -> Result<Parity, EnvError> {
    let mut next = || theirs.next().ok_or_else(|| peer_error(&"it stopped early"));
    let mut actions = RandomState::new(plan.seed.wrapping_add(1));
    let mut state = 0.0_f64;
    let mut rewards = 0.0_f64;
    let mut best_reward = 0.0_f64;
    let mut action = vec![0.0; task.action_dim()];
    for episode in 0..plan.episodes {
        if episode == 0 {
            task.reset(plan.seed.into())?;
        } else {
            task.reset_next()?;
        }
        for step in 0..=plan.steps {
            if step > 0 {
                if (step - 1) % HELD_STEPS == 0 {
                    action.fill_with(|| actions.uniform(-2.0, 2.0).clamp(-1.0, 1.0));
                }
                let reward = task.step(&action)?;
                rewards = rewards.max(distance(reward, next()?));
                best_reward = best_reward.max(reward);
            }
            for &value in task.qpos().iter().chain(task.qvel()) {
                state = state.max(distance(value, next()?));
            }
        }
    }
    Ok(Parity {
        id: task.id(),
        max_abs_state_diff: state,
        max_abs_reward_diff: rewards,
        best_reward,
    })
}

/// NaN must not look like agreement, as it would in a maximum.
fn distance(a: f64, b: f64) -> f64 {
    let distance = (a - b).abs();
    if distance.is_nan() {
        f64::INFINITY
    } else {
        distance
    }
}

fn peer_error(reason: &dyn Display) -> ControlError {
    ControlError::Peer {
        what: "drive dm_control",
        reason: reason.to_string(),
    }
}
