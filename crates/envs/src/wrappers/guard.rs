//! What keeps senseless rows away from agents and replay.

use isodream_core::EnvSpec;

use super::forward;
use crate::{EnvError, Environment, Transition};

/// Refuses a row that breaks the contract of [`Environment`]: an image of another size than the spec's, a
/// reward that is not finite, a discount outside `[0, 1]`, flags that contradict each other.
///
/// `step` counts from the reset, which is step 0.
///
/// # Errors
/// [`EnvError::InvalidTransition`] names environment, step and defect.
pub fn check_transition(spec: &EnvSpec, step: u64, row: &Transition) -> Result<(), EnvError> {
    let shape = &spec.image;
    let what = if row.image.len() != shape.bytes() {
        format!(
            "the image has {} bytes, {}x{}x{} need {}",
            row.image.len(),
            shape.height,
            shape.width,
            shape.channels,
            shape.bytes()
        )
    } else if !row.reward.is_finite() {
        format!("the reward is {}", row.reward)
    } else if !(0.0..=1.0).contains(&row.discount) {
        format!("the discount is {}, not in [0, 1]", row.discount)
    } else if row.is_terminal && !row.is_last {
        "it is terminal but not the last one".to_owned()
    } else if step == 0 && row.is_last {
        "the episode is over before its first step".to_owned()
    } else if step == 0 && row.reward != 0.0 {
        format!("the reset has reward {}", row.reward)
    } else {
        return Ok(());
    };
    Err(EnvError::InvalidTransition {
        id: spec.id.clone(),
        step,
        what,
    })
}

/// An environment whose rows are checked. After a refused row it has to be reset.
pub struct Guard {
    env: Box<dyn Environment>,
    step: Option<u64>,
}

impl Guard {
    /// Checks the rows of `env`.
    pub fn new(env: Box<dyn Environment>) -> Self {
        Self { env, step: None }
    }

    fn checked(&mut self, step: u64, row: Transition) -> Result<Transition, EnvError> {
        check_transition(self.env.spec(), step, &row)?;
        self.step = Some(step);
        Ok(row)
    }
}

impl Environment for Guard {
    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        self.step = None;
        let row = self.env.reset(seed)?;
        self.checked(0, row)
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        let step = self.step.ok_or(EnvError::NotReset)?;
        let row = self.env.step(action)?;
        self.step = None;
        self.checked(step + 1, row)
    }

    forward!(spec, segmentation, metrics, privileged, simulator);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{Fault, Script};

    #[test]
    fn faulty_rows_are_refused_until_the_next_reset() {
        for (fault, words) in [
            (Fault::NanReward, "the reward is NaN"),
            (Fault::ShortImage, "the image has 5 bytes, 2x2x3 need 12"),
        ] {
            let mut env = Guard::new(Script::of_length(9).with(fault, 2).boxed());
            env.reset(1).unwrap();
            env.step(&[0.0]).unwrap();
            let error = env.step(&[0.0]).unwrap_err();
            assert!(matches!(error, EnvError::InvalidTransition { step: 2, .. }));
            assert!(error.to_string().contains(words), "{error}");
            assert!(error.to_string().contains("test/script"), "{error}");
            assert_eq!(env.step(&[0.0]), Err(EnvError::NotReset));
            env.reset(1).unwrap();
            env.step(&[0.0]).unwrap();
        }
    }

    #[test]
    fn every_rule_is_checked() {
        let mut script = Script::of_length(2).terminal();
        let first = script.reset(0).unwrap();
        let spec = script.spec.clone();
        check_transition(&spec, 0, &first).unwrap();
        type Change = fn(&mut Transition);
        let broken: [(u64, Change); 6] = [
            (3, |row| row.reward = f32::INFINITY),
            (3, |row| row.discount = f32::NAN),
            (3, |row| row.discount = 1.5),
            (3, |row| row.is_terminal = true),
            (0, |row| row.is_last = true),
            (0, |row| row.reward = 0.5),
        ];
        for (index, (step, change)) in broken.into_iter().enumerate() {
            let mut row = first.clone();
            change(&mut row);
            assert!(check_transition(&spec, step, &row).is_err(), "rule {index}");
        }
    }

    #[test]
    fn a_sound_episode_passes_unchanged() {
        let mut plain = Script::of_length(3).terminal();
        let mut guarded = Guard::new(plain.clone().boxed());
        assert_eq!(guarded.reset(4), plain.reset(4));
        for _ in 0..3 {
            assert_eq!(guarded.step(&[0.5]), plain.step(&[0.5]));
        }
        assert_eq!(guarded.metrics(), [("steps", 3.0)]);
    }
}
