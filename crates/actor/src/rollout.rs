//! One episode of one environment under any policy.

use std::collections::BTreeMap;

use anyhow::Context;
use isodream_core::{Step, Steps};
use isodream_envs::{Driver, EndReason, Environment, PrivilegedView};
use isodream_model::Actions;

use crate::{AgentPolicy, Insight};

/// Who drives.
#[allow(missing_debug_implementations)] // drivers need not be printable
pub enum Pilot<'a> {
    /// A learned policy over one environment.
    Agent(&'a mut AgentPolicy, Actions),
    /// A scripted or random driver.
    Driver(&'a mut dyn Driver),
}

/// What an episode came to.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// Sum of rewards over agent steps.
    pub score: f64,
    /// Agent steps, the reset not counted.
    pub length: u32,
    /// Why it ended; none if it was stopped from outside.
    pub end_reason: Option<EndReason>,
    /// The environment's own measurements.
    pub metrics: BTreeMap<String, f64>,
}

/// One moment of an episode, for whoever watches it.
#[derive(Debug)]
pub struct Moment<'a> {
    /// What the pilot sees.
    pub step: &'a Step,
    /// The class of each pixel `[H, W]`, where the world knows it.
    pub classes: Option<&'a [u8]>,
    /// The ego and its neighbourhood, where the world knows them.
    pub view: Option<&'a PrivilegedView>,
    /// Whether another moved otherwise on account of the ego ([`isodream_envs::Transition::interaction`]).
    pub interaction: bool,
    /// What the decision that follows was made of; none of a driver, and where the episode ends.
    pub insight: Option<&'a Insight>,
}

/// Is shown an episode, moment after moment.
pub type Watch<'a> = &'a mut dyn FnMut(&Moment<'_>);

/// Runs one episode, or less if `go_on` says so, which is asked before each moment is shown.
///
/// # Errors
/// Where the environment fails.
pub fn episode(
    env: &mut dyn Environment,
    pilot: &mut Pilot<'_>,
    seed: u64,
    go_on: &dyn Fn() -> bool,
    watch: Watch<'_>,
) -> anyhow::Result<Outcome> {
    let mut transition = env.reset(seed).context("the environment failed to reset")?;
    let mut action = vec![0.0; env.spec().action_dim];
    let mut is_first = true;
    let mut score = 0.0;
    let mut length = 0;
    loop {
        let step = Step {
            image: transition.image,
            action: action.clone(),
            reward: transition.reward,
            discount: transition.discount,
            is_first,
            is_last: transition.is_last,
            is_terminal: transition.is_terminal,
        };
        score += f64::from(step.reward);
        let ends = step.is_last || !go_on();
        let (next, insight) = match pilot {
            _ if ends => (Vec::new(), None),
            Pilot::Agent(policy, actions) => {
                let (action, insight) = policy.act_with_insight(&step, *actions);
                (action, Some(insight))
            }
            Pilot::Driver(driver) => {
                let action = driver.act(env);
                let action = action.context("the driver cannot drive this environment")?;
                (action, None)
            }
        };
        watch(&Moment {
            step: &step,
            classes: env.segmentation().as_deref(),
            view: env.privileged().as_ref(),
            interaction: transition.interaction,
            insight: insight.as_ref(),
        });
        if ends {
            return Ok(Outcome {
                score,
                length,
                end_reason: transition.end_reason,
                metrics: env
                    .metrics()
                    .into_iter()
                    .map(|(name, value)| (name.to_owned(), value))
                    .collect(),
            });
        }
        action = next;
        is_first = false;
        transition = env
            .step(&action)
            .context("the environment failed to step")?;
        length += 1;
    }
}

/// An episode's steps with the class of each pixel.
#[derive(Debug)]
pub struct Recording {
    /// All steps.
    pub steps: Steps,
    /// Classes `[len, H, W]`; empty where the world does not know them.
    pub classes: Vec<u8>,
    /// Whether another moved otherwise on account of the ego, at each step.
    pub interactions: Vec<bool>,
}

/// Runs one episode and keeps all of it.
///
/// # Errors
/// As [`episode`].
pub fn record(
    env: &mut dyn Environment,
    pilot: &mut Pilot<'_>,
    seed: u64,
) -> anyhow::Result<(Outcome, Recording)> {
    let spec = env.spec().clone();
    let mut recording = Recording {
        steps: Steps::new(spec.image.bytes(), spec.action_dim),
        classes: Vec::new(),
        interactions: Vec::new(),
    };
    let outcome = episode(env, pilot, seed, &|| true, &mut |moment| {
        recording.steps.push(moment.step);
        recording.interactions.push(moment.interaction);
        recording
            .classes
            .extend(moment.classes.into_iter().flatten());
    })?;
    Ok((outcome, recording))
}
