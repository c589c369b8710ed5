//! The DeepMind Control Suite: dm_control's tasks on MuJoCo, bit for bit.
//!
//! [`ControlTask`] is one task with its physics, [`SceneRenderer`] draws it. The models are dm_control's own files, which
//! `cargo xtask setup` fetches; the order of computations and of random draws is dm_control's too, so that a seed
//! gives the same episode here and there. [`parity`] proves it against the real one.

mod assets;
mod environment;
mod error;
mod family;
mod library;
pub mod parity;
mod physics;
mod random;
mod rewards;
mod scene;
mod tasks;

use std::env;
use std::fmt;
use std::path::{Path, PathBuf};

use mujoco_rs::prelude::{MjData, MjModel};

pub use self::assets::Recolour;
pub use self::error::ControlError;
pub(crate) use self::family::CONTROL;
use self::physics::Physics;
use self::random::RandomState;
pub use self::scene::SceneRenderer;
use self::tasks::{Entry, TASKS, Task};
use crate::EnvError;
use crate::id::unknown;

/// Names another folder to read the models from.
pub const SUITE_DIR_VARIABLE: &str = "ISODREAM_SUITE_DIR";

/// The folder that `cargo xtask setup` fills.
const SUITE_DIR: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../.native/mujoco/suite");

/// Names of all tasks, such as `walker_walk`.
pub fn ids() -> impl Iterator<Item = &'static str> {
    TASKS.iter().map(|entry| entry.id)
}

/// The row of the table for the task `id`.
fn entry(id: &str) -> Result<&'static Entry, EnvError> {
    let found = TASKS.iter().find(|entry| entry.id == id);
    found.ok_or_else(|| unknown(id, &ids().collect::<Vec<_>>()))
}

/// One task of the suite with its simulation.
///
/// Episodes have no end here: in the suite every one of them takes 1,000 control steps.
pub struct ControlTask {
    entry: &'static Entry,
    physics: Physics,
    task: Box<dyn Task>,
    random: RandomState,
    phase: Phase,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    Loaded,
    Running,
    /// Invalid until the next reset.
    Broken,
}

impl ControlTask {
    /// The camera that pixel benchmarks look through.
    pub const CAMERA_ID: usize = 0;

    /// Loads the task of this name, one of [`ids`].
    ///
    /// # Errors
    /// If there is no such task, or if its model is missing or damaged.
    pub fn load(id: &str) -> Result<Self, EnvError> {
        let folder =
            env::var_os(SUITE_DIR_VARIABLE).map_or_else(|| SUITE_DIR.into(), PathBuf::from);
        Self::load_from(id, &folder)
    }

    /// [`load`](Self::load) with the models in `suite`.
    ///
    /// # Errors
    /// As there.
    pub fn load_from(id: &str, suite: &Path) -> Result<Self, EnvError> {
        let entry = entry(id)?;
        let path = suite.join(format!("{}.xml", entry.domain));
        let physics = Physics::load(&path)?;
        let task = (entry.make)(&physics)?;
        let actions = physics.model().actuator_ctrlrange().len();
        if actions != entry.actions {
            return Err(ControlError::Model {
                path,
                reason: format!("it has {actions} actuators, expected {}", entry.actions),
            }
            .into());
        }
        Ok(Self {
            entry,
            physics,
            task,
            random: RandomState::new(0),
            phase: Phase::Loaded,
        })
    }

    /// Name of the task.
    pub fn id(&self) -> &'static str {
        self.entry.id
    }

    /// dm_control's own names: the domain, and the task in it.
    pub fn domain_and_task(&self) -> (&'static str, &'static str) {
        self.entry.domain_and_task()
    }

    /// Number of components of an action.
    pub fn action_dim(&self) -> usize {
        self.entry.actions
    }

    /// Starts the first episode of an environment that dm_control seeds with the lower 32 bits of `seed`.
    ///
    /// # Errors
    /// If no valid state to start from is found.
    pub fn reset(&mut self, seed: u64) -> Result<(), EnvError> {
        self.random = RandomState::new(seed as u32);
        self.reset_next()
    }

    /// Starts the episode that follows in the same environment: the random numbers go on.
    ///
    /// # Errors
    /// As [`reset`](Self::reset).
    pub fn reset_next(&mut self) -> Result<(), EnvError> {
        self.phase = Phase::Broken;
        self.physics.reset();
        self.task.start(&mut self.physics, &mut self.random)?;
        self.physics.forward();
        self.physics.check()?;
        self.phase = Phase::Running;
        Ok(())
    }

    /// One control step with `action`, each component in `[-1, 1]` (beyond it: clamped) of its actuator's range.
    /// Returns the reward, in `[0, 1]`.
    ///
    /// # Errors
    /// If the action has the wrong dimension or is not finite, if no episode is running, or if the simulation
    /// becomes invalid.
    pub fn step(&mut self, action: &[f64]) -> Result<f64, EnvError> {
        match self.phase {
            Phase::Loaded => return Err(EnvError::NotReset),
            Phase::Broken => return Err(EnvError::EpisodeOver),
            Phase::Running => {}
        }
        if action.len() != self.action_dim() {
            return Err(EnvError::ActionDim {
                expected: self.action_dim(),
                actual: action.len(),
            });
        }
        if let Some(index) = action.iter().position(|value| !value.is_finite()) {
            return Err(EnvError::ActionNotFinite {
                index,
                value: action[index] as f32,
            });
        }
        for (index, value) in action.iter().enumerate() {
            let range = self.physics.model().actuator_ctrlrange()[index];
            self.physics.data_mut().ctrl_mut()[index] = to_range(value.clamp(-1.0, 1.0), range);
        }
        self.physics.step(self.entry.substeps);
        if let Err(error) = self.physics.check() {
            self.phase = Phase::Broken;
            return Err(error.into());
        }
        Ok(self.task.reward(&self.physics))
    }

    /// Positions of the joints `[nq]`, metres and radians.
    pub fn qpos(&self) -> &[f64] {
        self.physics.data().qpos()
    }

    /// Velocities of the joints `[nv]`.
    pub fn qvel(&self) -> &[f64] {
        self.physics.data().qvel()
    }

    /// The compiled model, as the task has changed it: targets move from episode to episode.
    pub fn model(&self) -> &MjModel {
        self.physics.model()
    }

    /// The state and all that is computed from it, current with [`qpos`](Self::qpos).
    pub fn data(&self) -> &MjData<Box<MjModel>> {
        self.physics.data()
    }

    /// As [`data`](Self::data), for MuJoCo's functions that use it as scratch space. What is changed here is part
    /// of the episode.
    pub fn data_mut(&mut self) -> &mut MjData<Box<MjModel>> {
        self.physics.data_mut()
    }
}

impl fmt::Debug for ControlTask {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ControlTask")
            .field("id", &self.entry.id)
            .field("phase", &self.phase)
            .finish_non_exhaustive()
    }
}

/// From `[-1, 1]` to `range`, exactly the same number where that is the range.
fn to_range(value: f64, [low, high]: [f64; 2]) -> f64 {
    if (low, high) == (-1.0, 1.0) {
        return value;
    }
    low + (high - low) * (0.5 * (value + 1.0))
}
