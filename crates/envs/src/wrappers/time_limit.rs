//! Episodes that end earlier.

use isodream_core::EnvSpec;

use super::forward;
use crate::{EndReason, EnvError, Environment, Transition};

/// Cuts episodes after a number of agent steps, for worlds that do not do so themselves.
pub struct TimeLimit {
    env: Box<dyn Environment>,
    spec: EnvSpec,
    steps: u32,
}

impl TimeLimit {
    /// Cuts the episodes of `env` after `limit` steps (at least one), unless its own limit is shorter.
    pub fn new(env: Box<dyn Environment>, limit: u32) -> Self {
        let mut spec = env.spec().clone();
        spec.time_limit = spec.time_limit.min(limit.max(1));
        Self {
            env,
            spec,
            steps: 0,
        }
    }
}

impl Environment for TimeLimit {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        self.steps = 0;
        self.env.reset(seed)
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        if self.steps >= self.spec.time_limit {
            return Err(EnvError::EpisodeOver);
        }
        let mut row = self.env.step(action)?;
        self.steps += 1;
        if self.steps >= self.spec.time_limit && !row.is_last {
            row.is_last = true;
            row.end_reason = Some(EndReason::TimeLimit);
        }
        Ok(row)
    }

    forward!(segmentation, metrics, privileged);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::Script;

    #[test]
    fn episodes_are_cut_without_being_terminal() {
        let mut env = TimeLimit::new(Script::of_length(9).terminal().boxed(), 2);
        assert_eq!(env.spec().time_limit, 2);
        for seed in 0..2 {
            env.reset(seed).unwrap();
            assert!(!env.step(&[0.0]).unwrap().is_last);
            let last = env.step(&[0.0]).unwrap();
            assert_eq!(
                (last.is_last, last.is_terminal, last.discount),
                (true, false, 1.0)
            );
            assert_eq!(last.end_reason, Some(EndReason::TimeLimit));
            assert_eq!(env.step(&[0.0]), Err(EnvError::EpisodeOver));
        }
    }

    #[test]
    fn an_end_inside_the_world_keeps_its_reason() {
        let mut env = TimeLimit::new(Script::of_length(2).terminal().boxed(), 2);
        env.reset(0).unwrap();
        env.step(&[0.0]).unwrap();
        let last = env.step(&[0.0]).unwrap();
        assert_eq!(
            (last.is_terminal, last.end_reason),
            (true, Some(EndReason::Stuck))
        );
    }
}
