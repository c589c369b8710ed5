//! One action for several steps.

use isodream_core::EnvSpec;
use isodream_core::config::RepeatReward;

use super::forward;
use crate::{EnvError, Environment, Transition};

/// Repeats every action, for worlds that do not do so themselves: ours have `action_repeat` built in, because
/// they then render once per agent step, and this renders every frame.
pub struct ActionRepeat {
    env: Box<dyn Environment>,
    spec: EnvSpec,
    repeat: u32,
    reward: RepeatReward,
}

impl ActionRepeat {
    /// Repeats the actions of `env` `repeat` times (at least once); their rewards make one as `reward` says.
    pub fn new(env: Box<dyn Environment>, repeat: u32, reward: RepeatReward) -> Self {
        let repeat = repeat.max(1);
        let mut spec = env.spec().clone();
        spec.action_repeat = spec.action_repeat.saturating_mul(repeat);
        spec.time_limit = spec.time_limit.div_ceil(repeat);
        Self {
            env,
            spec,
            repeat,
            reward,
        }
    }
}

impl Environment for ActionRepeat {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        self.env.reset(seed)
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        let mut row = self.env.step(action)?;
        let mut sum = f64::from(row.reward);
        let mut steps = 1;
        while steps < self.repeat && !row.is_last {
            let interaction = row.interaction;
            row = self.env.step(action)?;
            row.interaction |= interaction;
            sum += f64::from(row.reward);
            steps += 1;
        }
        row.reward = match self.reward {
            RepeatReward::Mean => sum / f64::from(steps),
            RepeatReward::Sum => sum,
        } as f32;
        Ok(row)
    }

    forward!(segmentation, metrics, privileged);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::Script;

    #[test]
    fn rewards_are_summed_or_averaged_over_the_steps_that_were_made() {
        // Rewards 1, 2, 3, 4, 5: steps of three, the second one cut by the end.
        for (how, expected) in [
            (RepeatReward::Sum, [6.0, 9.0]),
            (RepeatReward::Mean, [2.0, 4.5]),
        ] {
            let mut env = ActionRepeat::new(Script::of_length(5).boxed(), 3, how);
            assert_eq!((env.spec().action_repeat, env.spec().time_limit), (3, 34));
            env.reset(0).unwrap();
            let rows = [env.step(&[0.0]).unwrap(), env.step(&[0.0]).unwrap()];
            assert_eq!(rows.clone().map(|row| row.reward), expected);
            assert_eq!(rows.map(|row| row.is_last), [false, true]);
            assert_eq!(env.metrics(), [("steps", 5.0)]);
        }
    }
}
