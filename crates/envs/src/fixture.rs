//! A scripted world for tests of what is built around worlds.

use isodream_core::{EnvSpec, ImageShape};

use crate::environment::PrivilegedView;
use crate::{EndReason, EnvError, Environment, Transition};

/// What a [`Script`] does wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Fault {
    Error,
    Panic,
    NanReward,
    ShortImage,
}

/// A 2 x 2 world whose pixels tell seed and step, whose reward is its action plus the step's number, and
/// whose episodes are of a fixed length.
#[derive(Debug, Clone)]
pub(crate) struct Script {
    pub(crate) spec: EnvSpec,
    length: u32,
    fault: Option<(Fault, u32)>,
    is_terminal: bool,
    seed: u64,
    step: u32,
}

impl Script {
    pub(crate) fn of_length(length: u32) -> Self {
        Self {
            spec: EnvSpec {
                id: "test/script".into(),
                image: ImageShape {
                    height: 2,
                    width: 2,
                    channels: 3,
                },
                action_dim: 1,
                action_repeat: 1,
                time_limit: 100,
            },
            length,
            fault: None,
            is_terminal: false,
            seed: 0,
            step: 0,
        }
    }

    /// Fails once, at step `step` of an episode.
    pub(crate) fn with(mut self, fault: Fault, step: u32) -> Self {
        self.fault = Some((fault, step));
        self
    }

    /// Ends for a reason inside the world.
    pub(crate) fn terminal(mut self) -> Self {
        self.is_terminal = true;
        self
    }

    pub(crate) fn boxed(self) -> Box<dyn Environment> {
        Box::new(self)
    }

    fn row(&self, reward: f32) -> Transition {
        let is_last = self.step >= self.length;
        let is_terminal = is_last && self.is_terminal;
        let reason = if self.is_terminal {
            EndReason::Stuck
        } else {
            EndReason::TimeLimit
        };
        let mut image = [self.seed.to_le_bytes(), u64::from(self.step).to_le_bytes()].concat();
        image.truncate(self.spec.image.bytes());
        Transition {
            image,
            reward,
            discount: if is_terminal { 0.0 } else { 1.0 },
            is_last,
            is_terminal,
            interaction: false,
            end_reason: is_last.then_some(reason),
        }
    }
}

impl Environment for Script {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        self.seed = seed;
        self.step = 0;
        Ok(self.row(0.0))
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        self.step += 1;
        let mut row = self.row(action[0] + self.step as f32);
        match self.fault.take_if(|(_, step)| *step == self.step) {
            Some((Fault::Error, _)) => {
                return Err(EnvError::UnknownDriver {
                    name: "scripted".into(),
                    known: String::new(),
                });
            }
            Some((Fault::Panic, _)) => panic!("as scripted"),
            Some((Fault::NanReward, _)) => row.reward = f32::NAN,
            Some((Fault::ShortImage, _)) => row.image.truncate(5),
            None => {}
        }
        Ok(row)
    }

    fn segmentation(&self) -> Option<Vec<u8>> {
        Some(vec![0, 1, 2, 0])
    }

    fn metrics(&self) -> Vec<(&'static str, f64)> {
        vec![("steps", f64::from(self.step))]
    }

    fn privileged(&self) -> Option<PrivilegedView> {
        None
    }
}
