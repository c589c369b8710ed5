//! A driver that knows the future: it tries its plans in a copy of the world.

use super::Driver;
use super::controls::{Following, drive, view};
use super::reacting::ReactingDriver;
use crate::environment::{PrivilegedView, Simulator};
use crate::{EnvError, Environment};

/// Agent steps for which a plan is kept: one second.
const REPLAN_STEPS: u32 = 5;
/// Agent steps that a plan is tried for: eight seconds.
const HORIZON_STEPS: u32 = 40;
/// When a plan turns to its second lane, in agent steps.
const SECOND_AT_STEPS: u32 = 12;
/// What a plan's last speed is worth, in agent steps for which it is kept.
const WORTH_OF_SPEED_STEPS: f64 = 10.0;
/// Reward per agent step and m/s: what 0.05 s pay.
const REWARD_PER_M_S: f64 = 0.05;
/// How plans follow the car ahead.
const STYLES: [Following; 2] = [
    Following::NORMAL,
    Following {
        gap_m: 1.8,
        headway_s: 0.2,
        ..Following::NORMAL
    },
];

/// Tries plans for eight seconds with the others' true future, and drives as the best of them: what foresight can be
/// worth. A plan is one or two lanes and a way of following, or to drive on as [`ReactingDriver`] would.
#[derive(Debug, Clone, Default)]
pub struct ForeseeingDriver {
    plan: Option<Plan>,
    steps: u32,
}

#[derive(Debug, Clone)]
enum Plan {
    React(ReactingDriver),
    Lanes {
        first: usize,
        second: usize,
        following: Following,
        age_steps: u32,
    },
}

impl Plan {
    fn act(&mut self, view: &PrivilegedView) -> Vec<f32> {
        match self {
            Self::React(driver) => driver.decide(view),
            Self::Lanes {
                first,
                second,
                following,
                age_steps,
            } => {
                let turns = *age_steps >= SECOND_AT_STEPS;
                *age_steps += 1;
                drive(view, if turns { *second } else { *first }, *following)
            }
        }
    }

    /// What the plan earns in `world`, together with what its last speed promises.
    fn value(mut self, mut world: Box<dyn Simulator>) -> f64 {
        let mut sum = 0.0;
        for _ in 0..HORIZON_STEPS {
            let action = self.act(&world.privileged());
            let outlook = world.step(&action);
            sum += outlook.reward;
            if outlook.is_last {
                return sum;
            }
        }
        sum + WORTH_OF_SPEED_STEPS * REWARD_PER_M_S * world.privileged().speed_m_s
    }
}

/// The lane itself and those beside it.
fn lanes_from(lane: usize, lanes: usize) -> impl Iterator<Item = usize> {
    lane.saturating_sub(1)..=(lane + 1).min(lanes - 1)
}

/// Plans from the present lane.
fn plans(view: &PrivilegedView) -> Vec<Plan> {
    let mut plans = vec![Plan::React(ReactingDriver::default())];
    for following in STYLES {
        for first in lanes_from(view.lane, view.lanes) {
            plans.extend(lanes_from(first, view.lanes).map(|second| Plan::Lanes {
                first,
                second,
                following,
                age_steps: 0,
            }));
        }
    }
    plans
}

impl Driver for ForeseeingDriver {
    fn act(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        let view = view(env)?;
        if self.steps.is_multiple_of(REPLAN_STEPS) {
            let world = env.simulator().ok_or_else(|| EnvError::NoSimulator {
                id: env.spec().id.clone(),
            })?;
            let candidates = self.plan.take().into_iter().chain(plans(&view));
            let valued = candidates.map(|plan| (plan.clone().value(world.fork()), plan));
            let best = valued.max_by(|a, b| a.0.total_cmp(&b.0));
            self.plan = best.map(|(_, plan)| plan);
        }
        self.steps += 1;
        let plan = self
            .plan
            .get_or_insert_with(|| Plan::React(ReactingDriver::default()));
        Ok(plan.act(&view))
    }
}
