//! A task with its pictures: the environment that agents see.

use isodream_core::EnvSpec;
use isodream_core::config::RepeatReward;

use super::{ControlTask, SceneRenderer};
use crate::backgrounds::BackgroundPlayer;
use crate::environment::{EndReason, PrivilegedView, class};
use crate::raycast::Class;
use crate::{EnvError, Environment, Transition};

/// A task of the Control Suite, seen by its camera 0, with a video in the place of its sky (`video_easy`) or of sky
/// and floor (`video_hard`) where there is a player.
pub(super) struct ControlEnvironment {
    spec: EnvSpec,
    repeat_reward: RepeatReward,
    task: ControlTask,
    renderer: SceneRenderer,
    player: Option<BackgroundPlayer>,
    /// Pixels of the newest picture that show the video.
    replaced: Vec<bool>,
    steps: u32,
    phase: Phase,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Made,
    Running,
    Over,
}

impl ControlEnvironment {
    pub(super) fn new(
        spec: EnvSpec,
        repeat_reward: RepeatReward,
        task: ControlTask,
        renderer: SceneRenderer,
        player: Option<BackgroundPlayer>,
    ) -> Self {
        Self {
            renderer,
            spec,
            repeat_reward,
            task,
            player,
            replaced: Vec::new(),
            steps: 0,
            phase: Phase::Made,
        }
    }

    fn picture(&mut self) -> Result<Vec<u8>, EnvError> {
        let mut image = self.renderer.render(&mut self.task);
        if let Some(player) = &mut self.player {
            self.replaced = player.compose(&mut image)?;
        }
        Ok(image)
    }
}

impl Environment for ControlEnvironment {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        self.phase = Phase::Over;
        self.task.reset(seed)?;
        if let Some(player) = &mut self.player {
            player.reset(seed)?;
        }
        let image = self.picture()?;
        self.steps = 0;
        self.phase = Phase::Running;
        Ok(Transition::first(image))
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        match self.phase {
            Phase::Made => return Err(EnvError::NotReset),
            Phase::Over => return Err(EnvError::EpisodeOver),
            Phase::Running => {}
        }
        let action: Vec<f64> = action.iter().map(|&value| value.into()).collect();
        let mut sum = 0.0;
        for _ in 0..self.spec.action_repeat {
            sum += self.task.step(&action).inspect_err(|error| {
                // After a refused action the episode goes on, after a broken simulation it does not.
                if matches!(error, EnvError::Control(_)) {
                    self.phase = Phase::Over;
                }
            })?;
        }
        if let Some(player) = &mut self.player {
            player.advance();
        }
        self.steps += 1;
        let end_reason = (self.steps >= self.spec.time_limit).then_some(EndReason::TimeLimit);
        if end_reason.is_some() {
            self.phase = Phase::Over;
        }
        Ok(Transition {
            image: self.picture()?,
            reward: self.repeat_reward.combine(sum, self.spec.action_repeat),
            discount: 1.0,
            is_last: end_reason.is_some(),
            is_terminal: false,
            interaction: false,
            end_reason,
        })
    }

    /// The body is [`class::AGENT`], the floor [`class::ROAD`]; a video over them is background.
    fn segmentation(&self) -> Option<Vec<u8>> {
        if self.phase == Phase::Made {
            return None;
        }
        let mut classes: Vec<u8> = self
            .renderer
            .classes()
            .iter()
            .map(|seen| match seen {
                Class::Background => class::BACKGROUND,
                Class::Floor => class::ROAD,
                Class::Body => class::AGENT,
            })
            .collect();
        for (seen, &replaced) in classes.iter_mut().zip(&self.replaced) {
            if replaced {
                *seen = class::BACKGROUND;
            }
        }
        Some(classes)
    }

    fn metrics(&self) -> Vec<(&'static str, f64)> {
        Vec::new()
    }

    fn privileged(&self) -> Option<PrivilegedView> {
        None
    }
}
