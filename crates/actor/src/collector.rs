//! The thread that acts: steps a vector of environments and hands over every row.

use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use isodream_core::{Step, derive_seed};
use isodream_envs::{EnvError, Environment, VectorEnvironment};
use isodream_model::Actions;
use isodream_proto::v1;
use isodream_rpc::{AppendClient, Policy, RpcError};
use rand::RngExt;
use tokio_util::sync::CancellationToken;

use crate::exploration::Exploration;
use crate::failures::Failures;
use crate::lane::Lane;
use crate::learner_link::LearnerLink;
use crate::report::report;
use crate::{ActorOptions, AgentPolicy};

/// Pause before the environments are reset again after a reset that failed.
const RESET_PAUSE: Duration = Duration::from_secs(1);

pub(crate) struct Collector {
    options: ActorOptions,
    environments: VectorEnvironment,
    lanes: Vec<Lane>,
    exploration: Vec<Exploration>,
    /// Drawn at the start: everything random of this process follows from it.
    entropy: u64,
    failures: Failures,
}

/// The policy that acts, once there is one.
type Acting = Option<(Arc<Policy>, AgentPolicy)>;

impl Collector {
    pub(crate) fn new(
        options: ActorOptions,
        environments: Vec<Box<dyn Environment>>,
    ) -> anyhow::Result<Self> {
        let config = &options.config;
        let entropy: u64 = rand::rng().random();
        // No other episode of the run has the seeds that follow from this one.
        let seed = derive_seed(
            config.seed,
            &["collect", &options.actor_id, &entropy.to_string()],
        );
        let threads = usize::try_from(config.actor.threads).unwrap_or(1);
        let threads = NonZeroUsize::new(threads).unwrap_or(NonZeroUsize::MIN);
        let environments = VectorEnvironment::new(environments, seed, threads)?;
        let lane = |index| {
            Lane::new(
                &options.actor_id,
                entropy,
                index,
                config,
                environments.spec(),
            )
        };
        Ok(Self {
            lanes: (0..environments.len()).map(lane).collect(),
            exploration: (0..environments.len())
                .map(|index| {
                    let seed = derive_seed(entropy, &[&options.actor_id]);
                    Exploration::new(&config.actor, seed, index)
                })
                .collect(),
            environments,
            options,
            entropy,
            failures: Failures::default(),
        })
    }

    pub(crate) fn run(
        mut self,
        append: &AppendClient,
        link: &LearnerLink,
        shutdown: &CancellationToken,
    ) -> anyhow::Result<()> {
        tch::set_num_threads(self.options.config.actor.threads);
        tch::manual_seed(derive_seed(self.entropy, &["noise", &self.options.actor_id]) as i64);
        let mut policy = None;
        self.begin(shutdown)?;
        while !shutdown.is_cancelled() {
            for chunk in self.lanes.iter_mut().flat_map(Lane::take_chunks) {
                match append.send_blocking(chunk) {
                    Ok(()) => {}
                    Err(RpcError::Closed { .. }) if shutdown.is_cancelled() => return Ok(()),
                    Err(error) => return Err(error.into()),
                }
            }
            if let Some(newest) = link.newest()? {
                self.take(newest, &mut policy)?;
            }
            let version = policy.as_ref().map(|(published, _)| published.version());
            let actions = self.act(policy.as_mut().map(|(_, agent)| agent))?;
            if let Err(error) = self.advance(&actions, link, version) {
                self.failures.another(error.into())?;
                for lane in &mut self.lanes {
                    lane.abandon();
                }
                self.begin(shutdown)?;
            }
        }
        Ok(())
    }

    /// New episodes everywhere; environments that cannot be reset are tried again.
    fn begin(&mut self, shutdown: &CancellationToken) -> anyhow::Result<()> {
        while !shutdown.is_cancelled() {
            match self.environments.reset() {
                Ok(rows) => {
                    for (lane, row) in self.lanes.iter_mut().zip(rows) {
                        lane.begin(row);
                    }
                    for exploration in &mut self.exploration {
                        exploration.begin();
                    }
                    return Ok(());
                }
                Err(error) => self.failures.another(error.into())?,
            }
            std::thread::sleep(RESET_PAUSE);
        }
        Ok(())
    }

    fn take(&self, newest: Arc<Policy>, policy: &mut Acting) -> anyhow::Result<()> {
        match policy {
            Some((published, _)) if published.version() == newest.version() => return Ok(()),
            Some((published, agent)) => {
                agent
                    .load(newest.weights())
                    .context("the published policy does not fit this actor")?;
                *published = newest;
            }
            None => {
                let agent = AgentPolicy::new(
                    &self.options.config,
                    self.environments.spec(),
                    self.lanes.len(),
                    newest.weights(),
                )
                .context("the published policy does not fit this actor")?;
                tracing::info!(
                    version = newest.version().version,
                    "acting by the learner's policy"
                );
                *policy = Some((newest, agent));
            }
        }
        Ok(())
    }

    /// Actions `[N, A]` for the newest rows, row after row.
    fn act(&mut self, agent: Option<&mut AgentPolicy>) -> anyhow::Result<Vec<f32>> {
        let mut chosen = agent.map(|agent| {
            let steps: Vec<&Step> = self.lanes.iter().map(Lane::newest).collect();
            let how: Vec<Actions> = self.exploration.iter().map(Exploration::actions).collect();
            agent.act(&steps, &how).into_iter()
        });
        let mut actions = Vec::new();
        for (index, exploration) in self.exploration.iter_mut().enumerate() {
            let Some(env) = self.environments.environment(index) else {
                bail!("environment {index} is missing");
            };
            let action = match chosen.as_mut().and_then(Iterator::next) {
                Some(chosen) => exploration.instead(env)?.unwrap_or(chosen),
                None => exploration.prefill(env)?,
            };
            actions.extend(action);
        }
        Ok(actions)
    }

    /// One step of every environment. Episodes that end are reported, and the next ones begin.
    fn advance(
        &mut self,
        actions: &[f32],
        link: &LearnerLink,
        version: Option<v1::PolicyVersion>,
    ) -> Result<(), EnvError> {
        let steps = self.environments.step(actions)?;
        let action_dim = self.environments.spec().action_dim;
        let executed = actions.chunks(action_dim);
        let lanes = self.lanes.iter_mut().zip(&mut self.exploration);
        for (((lane, exploration), step), action) in lanes.zip(steps).zip(executed) {
            lane.go_on(step.transition, action.to_vec());
            let Some(next) = step.next else { continue };
            let (episode_id, outcome) = lane.finish(next.metrics);
            link.report(report(
                &self.options.actor_id,
                v1::ActorRole::Collect,
                version,
                episode_id,
                outcome,
            ));
            self.failures.none();
            lane.begin(next.first);
            exploration.begin();
        }
        Ok(())
    }
}
