//! The collecting actor: a vector of environments, sampled actions, every step appended to replay.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::Context;
use isodream_core::{EnvSpec, Step, derive_seed};
use isodream_envs::{Driver, EndReason, Environment, RandomDriver, Transition};
use isodream_model::Actions;
use isodream_proto::v1;
use isodream_rpc::{AppendClient, AppendOptions, RpcError};
use tokio_util::sync::CancellationToken;

use crate::chunks::ChunkBuilder;
use crate::evaluate::report;
use crate::learner_link::{LearnerLink, PublishedPolicy};
use crate::rollout::Outcome;
use crate::{ActorOptions, AgentPolicy};

/// How long unacknowledged chunks are waited for at shutdown.
const FLUSH_DEADLINE: Duration = Duration::from_secs(5);

/// How often a paused actor says why.
const WAIT_NOTICE: Duration = Duration::from_secs(10);

/// Collects until `shutdown`; acts at random until the learner publishes a first policy.
///
/// # Errors
/// Where the environment fails, or replay-server or learner refuse this actor.
pub async fn run(options: ActorOptions, shutdown: CancellationToken) -> anyhow::Result<()> {
    let spec = isodream_envs::spec(&options.config.env)?;
    let identity = options.identity(&spec);
    let link = LearnerLink::start(&options.learner, &identity, &options.actor_id)?;
    // Milliseconds since 1970: greater at every start, which is all an epoch must be.
    let epoch = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .context("the clock stands before 1970")?
        .as_millis() as u64;
    let append = AppendClient::start(AppendOptions {
        address: options.replay.clone(),
        identity,
        actor_id: options.actor_id.clone(),
        epoch,
        spool_chunks: options.config.actor.spool_chunks,
    })?;
    let append = Arc::new(append);

    let collector = Collector::new(&options, spec, epoch)?;
    let (sending, stop) = (append.clone(), shutdown.clone());
    let collecting = tokio::task::spawn_blocking(move || collector.run(&sending, &link, &stop));
    tokio::pin!(collecting);
    let mut notice = tokio::time::interval(WAIT_NOTICE);
    let collected = loop {
        tokio::select! {
            result = &mut collecting => break result.context("the collecting thread died")?,
            _ = notice.tick() => {
                if let Some(why) = append.waiting() {
                    tracing::info!(why, "environments are paused");
                }
            }
            () = shutdown.cancelled() => {
                append.close();
                break collecting.await.context("the collecting thread died")?;
            }
        }
    };
    collected?;
    if let Err(error) = append.flush(FLUSH_DEADLINE).await {
        tracing::warn!(%error, "unacknowledged steps were given up");
    }
    Ok(())
}

struct Collector {
    options: ActorOptions,
    spec: EnvSpec,
    lanes: Vec<Lane>,
    random: RandomDriver,
    episodes: u64,
    epoch: u64,
}

/// One environment and its running episode.
struct Lane {
    env: Box<dyn Environment>,
    chunks: ChunkBuilder,
    step: Step,
    score: f64,
    length: u32,
    end_reason: Option<EndReason>,
}

impl Collector {
    fn new(options: &ActorOptions, spec: EnvSpec, epoch: u64) -> anyhow::Result<Self> {
        let config = &options.config;
        let mut collector = Self {
            options: options.clone(),
            lanes: Vec::new(),
            random: RandomDriver::new(derive_seed(epoch, &["random", &options.actor_id])),
            episodes: 0,
            epoch,
            spec,
        };
        for index in 0..config.actor.environments {
            let spec = &collector.spec;
            let mut env = isodream_envs::make(&config.env)?;
            let chunks = ChunkBuilder::new(
                &options.actor_id,
                epoch,
                index,
                config.replay.chunk_steps,
                spec.image.bytes(),
                spec.action_dim,
            );
            let step = collector.reset(env.as_mut())?;
            collector.lanes.push(Lane {
                env,
                chunks,
                step,
                score: 0.0,
                length: 0,
                end_reason: None,
            });
        }
        Ok(collector)
    }

    /// Starts an episode on a seed that no other episode of the run has.
    fn reset(&mut self, env: &mut dyn Environment) -> anyhow::Result<Step> {
        let path = [
            "collect",
            &self.options.actor_id,
            &self.epoch.to_string(),
            &self.episodes.to_string(),
        ];
        let seed = derive_seed(self.options.config.seed, &path);
        self.episodes += 1;
        let first = env.reset(seed).context("the environment failed to reset")?;
        Ok(row(first, vec![0.0; self.spec.action_dim], true))
    }

    fn run(
        mut self,
        append: &AppendClient,
        link: &LearnerLink,
        shutdown: &CancellationToken,
    ) -> anyhow::Result<()> {
        tch::set_num_threads(self.options.config.actor.threads);
        tch::manual_seed(derive_seed(self.epoch, &["noise", &self.options.actor_id]) as i64);
        let mut policy: Option<(Arc<PublishedPolicy>, AgentPolicy)> = None;
        while !shutdown.is_cancelled() {
            if let Some(newest) = link.newest()? {
                self.take(newest, &mut policy)?;
            }
            for lane in &mut self.lanes {
                let Some(chunk) = lane.chunks.push(&lane.step) else {
                    continue;
                };
                match append.send_blocking(chunk) {
                    Ok(()) => {}
                    Err(RpcError::Closed { .. }) if shutdown.is_cancelled() => return Ok(()),
                    Err(error) => return Err(error.into()),
                }
            }
            let version = policy.as_ref().map(|(published, _)| published.version);
            self.report_episodes(link, version);
            self.advance(policy.as_mut().map(|(_, agent)| agent))?;
        }
        Ok(())
    }

    fn take(
        &self,
        newest: Arc<PublishedPolicy>,
        policy: &mut Option<(Arc<PublishedPolicy>, AgentPolicy)>,
    ) -> anyhow::Result<()> {
        match policy {
            Some((published, _)) if published.version == newest.version => return Ok(()),
            Some((published, agent)) => {
                agent
                    .load(&newest.weights)
                    .context("the published policy does not fit this actor")?;
                *published = newest;
            }
            None => {
                let agent = AgentPolicy::new(
                    &self.options.config,
                    &self.spec,
                    self.lanes.len(),
                    &newest.weights,
                )
                .context("the published policy does not fit this actor")?;
                tracing::info!(
                    version = newest.version.version,
                    "acting by the learner's policy"
                );
                *policy = Some((newest, agent));
            }
        }
        Ok(())
    }

    /// Reports the episodes whose last step was just handed over. Their environments start anew in
    /// [`Self::advance`].
    fn report_episodes(&self, link: &LearnerLink, version: Option<v1::PolicyVersion>) {
        for lane in self.lanes.iter().filter(|lane| lane.step.is_last) {
            let outcome = Outcome {
                score: lane.score,
                length: lane.length,
                end_reason: lane.end_reason,
                metrics: lane
                    .env
                    .metrics()
                    .into_iter()
                    .map(|(n, v)| (n.to_owned(), v))
                    .collect(),
            };
            let id = lane.chunks.episode_id();
            link.report(report(
                &self.options.actor_id,
                v1::ActorRole::Collect,
                version,
                id,
                outcome,
            ));
        }
    }

    /// One step of every environment; those at their end are reset instead.
    fn advance(&mut self, agent: Option<&mut AgentPolicy>) -> anyhow::Result<()> {
        let actions = match agent {
            Some(agent) => {
                let steps: Vec<&Step> = self.lanes.iter().map(|lane| &lane.step).collect();
                agent.act(&steps, Actions::Sample)
            }
            None => {
                let random = &mut self.random;
                self.lanes
                    .iter()
                    .map(|lane| random.act(lane.env.as_ref()))
                    .collect::<Result<_, _>>()?
            }
        };
        for (index, action) in actions.into_iter().enumerate() {
            if self.lanes[index].step.is_last {
                let mut lane = self.lanes.swap_remove(index);
                lane.step = self.reset(lane.env.as_mut())?;
                (lane.score, lane.length) = (0.0, 0);
                self.lanes.push(lane);
                let last = self.lanes.len() - 1;
                self.lanes.swap(index, last);
                continue;
            }
            let lane = &mut self.lanes[index];
            let transition = lane
                .env
                .step(&action)
                .context("the environment failed to step")?;
            lane.score += f64::from(transition.reward);
            lane.length += 1;
            lane.end_reason = transition.end_reason;
            lane.step = row(transition, action, false);
        }
        Ok(())
    }
}

fn row(transition: Transition, action: Vec<f32>, is_first: bool) -> Step {
    Step {
        image: transition.image,
        action,
        reward: transition.reward,
        discount: transition.discount,
        is_first,
        is_last: transition.is_last,
        is_terminal: transition.is_terminal,
    }
}
