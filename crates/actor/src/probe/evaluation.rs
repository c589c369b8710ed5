//! The probe that follows an evaluation.

use std::time::Instant;

use isodream_core::{Config, derive_seed};
use isodream_envs::Environment;
use isodream_model::RewardModel;
use isodream_proto::v1;
use isodream_telemetry::probe::Probe;

use super::{Episode, Extent, Finding, States, probe};
use crate::AgentPolicy;

/// Steps of a plan.
const HORIZON: usize = 15;
/// The latest step that is probed: an evaluation is followed by seconds of probing, not by minutes.
const LATEST: usize = 50;
/// Episodes of an evaluation that are kept to be repeated.
const EPISODES: usize = 4;

/// Keeps episodes of an evaluation and probes the world model at states of them.
#[derive(Debug)]
pub(crate) struct EvaluationProbe {
    /// None where nothing is probed, or not any more.
    extent: Option<Extent>,
    episodes: Vec<Episode>,
}

impl EvaluationProbe {
    pub(crate) fn new(config: &Config) -> Self {
        let states = config.actor.probe_states;
        Self {
            extent: (states > 0).then(|| Extent {
                states: States::Total(states),
                horizon: HORIZON,
                latest: LATEST,
                seed: derive_seed(config.seed, &["probe"]),
            }),
            episodes: Vec::new(),
        }
    }

    /// Where to put the episode of `seed` that begins; none where it is not needed.
    pub(crate) fn begin(&self, seed: u64) -> Option<Episode> {
        let needed = self.extent.is_some() && self.episodes.len() < EPISODES;
        needed.then(|| Episode::new(seed))
    }

    /// Keeps an episode that ended well.
    pub(crate) fn keep(&mut self, episode: Option<Episode>) {
        self.episodes.extend(episode);
    }

    /// Probes the model of `weights`, by which `agent` drove the episodes, and forgets these. None where it cannot be
    /// probed; the log says why.
    pub(crate) fn run(
        &mut self,
        env: &mut dyn Environment,
        agent: &mut AgentPolicy,
        config: &Config,
        weights: &[u8],
        go_on: &dyn Fn() -> bool,
    ) -> Option<v1::Probe> {
        let (extent, episodes) = (self.extent?, std::mem::take(&mut self.episodes));
        let begun = Instant::now();
        let found = RewardModel::new(config, weights)
            .map_err(anyhow::Error::new)
            .and_then(|reward| probe(env, agent, &reward, &episodes, extent, go_on));
        match found {
            Ok(Finding::Compared(probe)) => {
                let secs = begun.elapsed().as_secs_f64();
                tracing::debug!(secs, states = probe.states.len(), "probed the world model");
                return Some(message(probe));
            }
            Ok(Finding::TooShort | Finding::Stopped) => {}
            Ok(Finding::Unrepeatable) => {
                tracing::warn!(
                    "the environment does not repeat itself from a seed, so that the world model is not probed"
                );
                self.extent = None;
            }
            Err(error) => {
                let error = format!("{error:#}");
                tracing::warn!(error, "the world model cannot be probed this time");
            }
        }
        None
    }
}

/// A probe in the words of the protocol.
fn message(probe: Probe) -> v1::Probe {
    v1::Probe {
        horizon: probe.horizon,
        plans: probe.plans,
        states: probe
            .states
            .into_iter()
            .map(|state| v1::ProbedState {
                kind: state.kind,
                real: state.real,
                imagined: state.imagined,
            })
            .collect(),
    }
}
