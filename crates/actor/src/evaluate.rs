//! The evaluating actor: mode actions on seeds of its own, never a word to replay.

use std::time::Duration;

use anyhow::Context;
use isodream_core::derive_seed;
use isodream_model::Actions;
use isodream_proto::v1;
use isodream_rpc::open_environment;
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;

use crate::failures::Failures;
use crate::film::Film;
use crate::learner_link::LearnerLink;
use crate::probe::EvaluationProbe;
use crate::report::report;
use crate::rollout::{Moment, Pilot, episode};
use crate::{ActorOptions, AgentPolicy};

/// How often the learner is asked whether an evaluation is due.
const POLL: Duration = Duration::from_millis(500);

/// The seed of evaluation episode `index`: a branch of the seed tree that training never takes.
pub fn evaluation_seed(root: u64, index: u64) -> u64 {
    derive_seed(root, &["evaluate", &index.to_string()])
}

/// Evaluates the newest policy every `evaluate_interval_frames` until `shutdown`.
///
/// # Errors
/// Where the environment fails again and again, or the learner refuses this actor.
pub async fn run(options: ActorOptions, shutdown: CancellationToken) -> anyhow::Result<()> {
    let (opening, dialer) = (options.config.env.clone(), options.dialer.clone());
    let mut env = tokio::task::spawn_blocking(move || open_environment(&dialer, &opening))
        .await
        .context("the task that opens the environment failed")??;
    let spec = env.spec().clone();
    let link = LearnerLink::start(
        &options.dialer,
        &options.learner,
        &options.identity(&spec),
        &options.actor_id,
    )?;
    let client = options.dialer.learner(&options.learner)?;
    let runtime = Handle::current();
    let actor = move || -> anyhow::Result<()> {
        let config = &options.config;
        tch::set_num_threads(config.actor.threads);
        tch::manual_seed(derive_seed(config.seed, &["noise", &options.actor_id]) as i64);
        let mut agent: Option<AgentPolicy> = None;
        let mut failures = Failures::default();
        let mut probing = EvaluationProbe::new(config);
        let mut due_frames = 0;
        while !shutdown.is_cancelled() {
            let mut client = client.clone();
            let status = runtime.block_on(client.status(v1::LearnerStatusRequest {}));
            let frames = status.map_or(0, |status| status.into_inner().env_frames);
            let Some(policy) = link.newest()?.filter(|_| frames >= due_frames) else {
                std::thread::sleep(POLL);
                continue;
            };
            due_frames = frames + config.actor.evaluate_interval_frames;
            match &mut agent {
                Some(agent) => agent.load(policy.weights()),
                None => AgentPolicy::new(config, &spec, 1, policy.weights())
                    .map(|new| agent = Some(new)),
            }
            .context("the published policy does not fit this actor")?;
            let agent = agent.as_mut().context("a policy was just loaded")?;
            let episodes = u64::from(config.actor.evaluate_episodes);
            for index in 0..episodes {
                let mut pilot = Pilot::Agent(agent, Actions::Mode);
                let seed = evaluation_seed(config.seed, index);
                let go_on = || !shutdown.is_cancelled();
                // The first episode of each evaluation is shown, always on the same seed.
                let mut film = (index == 0).then(Film::default);
                let mut kept = probing.begin(seed);
                let mut watch = |moment: &Moment<'_>| {
                    if let Some(film) = &mut film {
                        film.take(moment, &spec);
                    }
                    if let Some(kept) = &mut kept {
                        kept.take(moment);
                    }
                };
                let span = tracing::debug_span!("evaluate", actor = options.actor_id, index);
                let run = || episode(env.as_mut(), &mut pilot, seed, &go_on, &mut watch);
                let outcome = match span.in_scope(run) {
                    Ok(outcome) => outcome,
                    Err(error) => {
                        failures.another(error)?;
                        continue;
                    }
                };
                failures.none();
                if outcome.end_reason.is_some() {
                    probing.keep(kept);
                    let mut run =
                        || probing.run(env.as_mut(), agent, config, policy.weights(), &go_on);
                    link.report(v1::EpisodeReport {
                        probe: (index + 1 == episodes).then(&mut run).flatten(),
                        film: film.and_then(|film| film.develop(&spec)),
                        ..report(
                            &options.actor_id,
                            v1::ActorRole::Evaluate,
                            Some(policy.version()),
                            seed,
                            outcome,
                        )
                    });
                }
            }
        }
        Ok(())
    };
    tokio::task::spawn_blocking(actor)
        .await
        .context("the evaluating thread died")?
}
