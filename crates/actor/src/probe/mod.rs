//! A probe of the world model: what other actions bring, really and in imagination.
//!
//! At states that the policy met, each of some plans is followed twice. Really: the episode is repeated from its seed up
//! to the state, and the plan goes on from there. In imagination: the model goes on from the state's latents by the
//! very actions that were taken. Both give the sum of rewards over the steps that were made.

mod evaluation;
mod plans;
mod states;

use anyhow::Context;
use isodream_core::Step;
use isodream_envs::Environment;
use isodream_model::reward::Plans;
use isodream_model::rssm::{State, stack};
use isodream_model::{Actions, RewardModel};
use isodream_telemetry::probe::{Probe, ProbedState};
use tch::Tensor;

pub(crate) use self::evaluation::EvaluationProbe;
use self::plans::Plan;
use self::states::Place;
pub use self::states::{Episode, States};
use crate::AgentPolicy;

/// Imagined futures that a return is a mean over.
const SAMPLES: i64 = 16;

/// How much a probe does.
#[derive(Debug, Clone, Copy)]
pub struct Extent {
    /// States that are probed.
    pub states: States,
    /// Steps of a plan.
    pub horizon: usize,
    /// The latest step of an episode that is a state: what comes later costs more to repeat.
    pub latest: usize,
    /// Seed of actions that are drawn.
    pub seed: u64,
}

/// How a probe ended.
#[derive(Debug)]
pub enum Finding {
    /// What was compared.
    Compared(Probe),
    /// No episode is long enough.
    TooShort,
    /// The environment shows something else when the same seed and actions come again.
    Unrepeatable,
    /// It was told to stop.
    Stopped,
}

/// Compares real and imagined returns at states of `episodes`, all of which `agent` drove in `env`. The agent's memory
/// is another one afterwards. `go_on` is asked before each plan.
///
/// # Errors
/// Where the environment fails.
pub fn probe(
    env: &mut dyn Environment,
    agent: &mut AgentPolicy,
    reward: &RewardModel,
    episodes: &[Episode],
    extent: Extent,
    go_on: &dyn Fn() -> bool,
) -> anyhow::Result<Finding> {
    let places = states::choose(episodes, extent.horizon, extent.latest, extent.states);
    if places.is_empty() {
        return Ok(Finding::TooShort);
    }
    let (names, plans): (Vec<String>, Vec<Plan>) =
        plans::plans(env, extent.seed)?.into_iter().unzip();
    let mut starts = Vec::new();
    let mut ways = Vec::new();
    for (index, episode) in episodes.iter().enumerate() {
        let here = || places.iter().filter(|place| place.episode == index);
        if here().next().is_none() {
            continue;
        }
        let memories = agent.memories(&episode.steps);
        for place in here() {
            let row = place.row as i64;
            for plan in &plans {
                if !go_on() {
                    return Ok(Finding::Stopped);
                }
                agent.remember(memories.map(|x| x.narrow(0, row, 1)));
                match follow(env, agent, episode, place, plan, extent.horizon)? {
                    Some(way) => ways.push(way),
                    None => return Ok(Finding::Unrepeatable),
                }
                starts.push(memories.state.map(|x| x.get(row)));
            }
        }
    }
    let imagined =
        agent.imagined_returns(reward, &to_imagine(&starts, &ways, extent.horizon), SAMPLES);
    let real: Vec<f64> = ways.iter().map(Way::score).collect();
    let by_place = real.chunks(plans.len()).zip(imagined.chunks(plans.len()));
    let states = places
        .iter()
        .zip(by_place)
        .map(|(place, (real, imagined))| ProbedState {
            kind: place.kind.as_str().to_owned(),
            real: real.to_vec(),
            imagined: imagined.to_vec(),
        });
    Ok(Finding::Compared(Probe {
        horizon: extent.horizon as u32,
        plans: names,
        states: states.collect(),
    }))
}

/// What really followed.
#[derive(Debug, Default)]
struct Way {
    actions: Vec<Vec<f32>>,
    rewards: Vec<f32>,
}

impl Way {
    fn score(&self) -> f64 {
        self.rewards.iter().copied().map(f64::from).sum()
    }
}

/// Repeats `episode` up to `place` and follows `plan` from there, to the end of the episode at most; the agent's memory
/// is that of the place. None where the environment does not show the same picture there.
fn follow(
    env: &mut dyn Environment,
    agent: &mut AgentPolicy,
    episode: &Episode,
    place: &Place,
    plan: &Plan,
    horizon: usize,
) -> anyhow::Result<Option<Way>> {
    const FAILED: &str = "the environment failed while an episode was repeated";
    let steps = &episode.steps;
    let action_of =
        |row: usize| &steps.actions[row * steps.action_dim..(row + 1) * steps.action_dim];
    let mut transition = env.reset(episode.seed).context(FAILED)?;
    for row in 1..=place.row {
        if transition.is_last {
            return Ok(None);
        }
        transition = env.step(action_of(row)).context(FAILED)?;
    }
    let image = &steps.images[place.row * steps.image_bytes..(place.row + 1) * steps.image_bytes];
    if transition.image != image || transition.is_last {
        return Ok(None);
    }
    let mut way = Way::default();
    // What the policy did here is known; from now on it sees what the plan leads to.
    let mut policy = action_of(place.row + 1).to_vec();
    for step in 0..horizon {
        let action = plan.action(step, &policy);
        let transition = env.step(&action).context(FAILED)?;
        way.actions.push(action.clone());
        way.rewards.push(transition.reward);
        if transition.is_last {
            break;
        }
        if plan.asks_policy() && step + 1 < horizon {
            let seen = Step {
                image: transition.image,
                action,
                reward: transition.reward,
                discount: transition.discount,
                is_first: false,
                is_last: false,
                is_terminal: false,
            };
            policy = agent.act(&[&seen], &[Actions::Mode]).remove(0);
        }
    }
    Ok(Some(way))
}

/// All ways as a batch; those that ended early are filled up with what does not count.
fn to_imagine(starts: &[State], ways: &[Way], horizon: usize) -> Plans {
    let dim = ways[0].actions[0].len();
    let mut actions = Vec::new();
    let mut counted = Vec::new();
    for way in ways {
        for step in 0..horizon {
            let taken = way.actions.get(step);
            match taken {
                Some(action) => actions.extend(action),
                None => actions.extend(std::iter::repeat_n(0.0, dim)),
            }
            counted.push(f32::from(u8::from(taken.is_some())));
        }
    }
    let [count, horizon, dim] = [ways.len(), horizon, dim].map(|size| size as i64);
    Plans {
        starts: stack(starts, 0),
        actions: Tensor::from_slice(&actions).view([count, horizon, dim]),
        counted: Tensor::from_slice(&counted).view([count, horizon]),
    }
}
