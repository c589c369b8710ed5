//! The tasks: how each of them starts, and what it rewards.
//!
//! Facts are those of dm_control 1.0.50. Another task is a file beside this one and a line in [`TASKS`].

mod acrobot;
mod ball_in_cup;
mod cartpole;
mod cheetah;
mod finger;
mod fish;
mod hopper;
mod humanoid;
mod joints;
mod pendulum;
mod point_mass;
mod reacher;
mod walker;

use super::ControlError;
use super::physics::Physics;
use super::random::RandomState;

/// What makes a task out of a model.
pub(super) trait Task: Send {
    /// Draws the first state of an episode into `physics`, which is in the model's own pose: a random pose
    /// where a task says nothing else.
    fn start(
        &mut self,
        physics: &mut Physics,
        random: &mut RandomState,
    ) -> Result<(), ControlError> {
        joints::randomize(physics, random);
        Ok(())
    }

    /// The reward for having arrived in the present state.
    fn reward(&self, physics: &Physics) -> f64;
}

/// A task that knows its model.
type Made = Result<Box<dyn Task>, ControlError>;

/// A row of the table of tasks.
pub(super) struct Entry {
    pub(super) id: &'static str,
    /// Names the model's file, and begins the id.
    pub(super) domain: &'static str,
    /// Time steps of the model per control step.
    pub(super) substeps: usize,
    /// Components of an action, known without loading the model.
    pub(super) actions: usize,
    pub(super) make: fn(&Physics) -> Made,
}

impl Entry {
    pub(super) fn domain_and_task(&self) -> (&'static str, &'static str) {
        (self.domain, &self.id[self.domain.len() + 1..])
    }
}

/// All tasks, those of the paper first. The last numbers are speeds in m/s and radii of targets in m.
#[rustfmt::skip]
pub(super) const TASKS: &[Entry] = &[
    entry("finger_spin", "finger", 2, 2, finger::spin),
    entry("hopper_stand", "hopper", 4, 4, hopper::stand),
    entry("walker_walk", "walker", 10, 6, |p| walker::new(p, Some(1.0))),
    entry("cheetah_run", "cheetah", 1, 6, cheetah::run),
    entry("acrobot_swingup", "acrobot", 1, 1, acrobot::swingup),
    entry("acrobot_swingup_sparse", "acrobot", 1, 1, acrobot::swingup_sparse),
    entry("ball_in_cup_catch", "ball_in_cup", 10, 2, ball_in_cup::catch),
    entry("cartpole_balance", "cartpole", 1, 1, cartpole::balance),
    entry("cartpole_balance_sparse", "cartpole", 1, 1, cartpole::balance_sparse),
    entry("cartpole_swingup", "cartpole", 1, 1, cartpole::swingup),
    entry("cartpole_swingup_sparse", "cartpole", 1, 1, cartpole::swingup_sparse),
    entry("finger_turn_easy", "finger", 2, 2, |p| finger::turn(p, 0.07)),
    entry("finger_turn_hard", "finger", 2, 2, |p| finger::turn(p, 0.03)),
    entry("fish_swim", "fish", 10, 5, fish::swim),
    entry("fish_upright", "fish", 10, 5, fish::upright),
    entry("hopper_hop", "hopper", 4, 4, hopper::hop),
    entry("humanoid_run", "humanoid", 5, 21, |p| humanoid::new(p, Some(10.0))),
    entry("humanoid_stand", "humanoid", 5, 21, |p| humanoid::new(p, None)),
    entry("humanoid_walk", "humanoid", 5, 21, |p| humanoid::new(p, Some(1.0))),
    entry("pendulum_swingup", "pendulum", 1, 1, pendulum::swingup),
    entry("point_mass_easy", "point_mass", 1, 2, point_mass::easy),
    entry("reacher_easy", "reacher", 1, 2, |p| reacher::new(p, 0.05)),
    entry("reacher_hard", "reacher", 1, 2, |p| reacher::new(p, 0.015)),
    entry("walker_run", "walker", 10, 6, |p| walker::new(p, Some(8.0))),
    entry("walker_stand", "walker", 10, 6, |p| walker::new(p, None)),
];

const fn entry(
    id: &'static str,
    domain: &'static str,
    substeps: usize,
    actions: usize,
    make: fn(&Physics) -> Made,
) -> Entry {
    Entry {
        id,
        domain,
        substeps,
        actions,
        make,
    }
}

/// Euclidean length.
fn norm(vector: &[f64]) -> f64 {
    vector.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// From `a` to `b`.
fn difference(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [b[0] - a[0], b[1] - a[1], b[2] - a[2]]
}
