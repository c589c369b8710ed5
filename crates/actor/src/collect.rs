//! The collecting actor: a vector of environments, sampled actions, every step appended to replay.

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use isodream_rpc::limits::FAILOVER_AFTER;
use isodream_rpc::{AppendClient, AppendOptions, open_environments};
use tokio_util::sync::CancellationToken;

use crate::ActorOptions;
use crate::collector::Collector;
use crate::learner_link::LearnerLink;

/// How long unacknowledged chunks are waited for at shutdown.
const FLUSH_DEADLINE: Duration = Duration::from_secs(5);

/// How often a paused actor says why.
const WAIT_NOTICE: Duration = Duration::from_secs(10);

/// Collects until `shutdown`; acts at random until the learner publishes a first policy.
///
/// # Errors
/// Where the environments fail again and again, or replay-server or learner refuse this actor.
pub async fn run(options: ActorOptions, shutdown: CancellationToken) -> anyhow::Result<()> {
    let (opening, dialer) = (options.config.clone(), options.dialer.clone());
    let environments = tokio::task::spawn_blocking(move || {
        open_environments(&dialer, &opening.env, opening.actor.environments)
    })
    .await
    .context("the task that opens the environments failed")??;
    let spec = isodream_envs::common_spec(&environments)?;
    let identity = options.identity(&spec);
    let link = LearnerLink::start(
        &options.dialer,
        &options.learner,
        &identity,
        &options.actor_id,
    )?;
    let appending = AppendOptions {
        addresses: options.replay.clone(),
        identity,
        actor_id: options.actor_id.clone(),
        spool_chunks: options.config.actor.spool_chunks,
        spool_bytes: options.config.actor.spool_mb << 20,
        failover_after: FAILOVER_AFTER,
    };
    let append = Arc::new(AppendClient::start(&options.dialer, appending)?);

    let collector = Collector::new(options, environments)?;
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
