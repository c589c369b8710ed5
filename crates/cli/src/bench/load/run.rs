//! The measurement: servers up, actors joined, load, what came of it.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use isodream_core::config::EnvConfig;
use isodream_core::{Config, codec};
use isodream_proto::Identity;
use isodream_rpc::{AppendClient, Dialer, Role, SampleClient};
use rand::RngExt;
use rustix::process::{Resource, getrlimit, setrlimit};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use super::LoadArgs;
use super::actor::{Crowd, Recorded};
use super::board::Board;
use super::commits::CommitLoad;
use super::result::LoadBench;
use super::sampler;
use super::servers::Servers;
use crate::bench::frames;

/// Files that a process needs beside its connections.
const SPARE_FILES: u64 = 200;

/// Runs everything once.
pub(super) async fn measure(args: &LoadArgs) -> anyhow::Result<LoadBench> {
    let config = args.config.load()?;
    // Own servers listen on loopback, and ask for nothing.
    let acting = args.security.dialer(Role::Actor)?;
    let learning = args.security.dialer(Role::Learner)?;
    raise_file_limit(2 * args.actors + SPARE_FILES)?;
    let spec = isodream_envs::spec(&config.env)?;
    let identity = Identity::new(&spec, config.model_hash());
    let episodes = record(&config, spec.action_dim, args)?;
    let mut servers = Servers::start(args, &identity)?;
    servers.up(&Dialer::default()).await?;
    let replay = match args.replay.as_slice() {
        [] => servers.addresses(),
        named => named.to_vec(),
    };
    let learners = servers.learners(args, &replay);

    let board = Arc::new(Board::new(args.actors));
    servers.publish(&board)?;
    let stop = CancellationToken::new();
    let crowd = Arc::new(Crowd {
        actors: args.actors,
        identity: identity.clone(),
        entropy: rand::rng().random(),
        replay: replay.clone(),
        episodes,
        steps_per_second: (args.steps_per_second > 0.0).then_some(args.steps_per_second),
        spool_chunks: config.actor.spool_chunks,
        spool_bytes: config.actor.spool_mb << 20,
        board: board.clone(),
        stop: stop.clone(),
    });
    let mut actors = JoinSet::new();
    let joining = Instant::now();
    for index in 0..args.actors {
        let append = AppendClient::start(&acting, crowd.appending(index))?;
        let learner = acting.learner(&learners[index as usize % learners.len()])?;
        actors.spawn(crowd.clone().act(index, append, learner));
    }
    let mut drawing = JoinSet::new();
    for index in 0..u64::from(args.learners) {
        let options = sampler::sampling(&config, &identity, &replay, index);
        let length = options.sequence_length;
        let client = SampleClient::start(&learning, options)?;
        drawing.spawn(sampler::draw(client, length, board.clone()));
    }
    joined(&board, args, joining, &mut actors).await?;
    let join_seconds = joining.elapsed().as_secs_f64();

    let before = (servers.usage()?, servers.commits().await?);
    let begun = Instant::now();
    board.measure(true);
    let mut publishing = tokio::time::interval(Duration::from_secs_f64(args.publish_seconds));
    let end = tokio::time::sleep(Duration::from_secs_f64(args.seconds));
    tokio::pin!(end);
    loop {
        tokio::select! {
            () = &mut end => break,
            _ = publishing.tick() => servers.publish(&board)?,
            Some(ended) = actors.join_next() => {
                ended.context("an actor's task died")??;
                bail!("an actor ended before the measurement did");
            }
            Some(ended) = drawing.join_next() => {
                return Err(ended.context("a learner's task died")?.into());
            }
        }
    }
    board.measure(false);
    let seconds = begun.elapsed().as_secs_f64();
    let after = (servers.usage()?, servers.commits().await?);
    let fan_out = board.fan_out();
    // What was handed over becomes durable, or this fails.
    stop.cancel();
    while let Some(ended) = actors.join_next().await {
        ended.context("an actor's task died")??;
    }
    let total = |counter: &std::sync::atomic::AtomicU64| counter.load(Ordering::Relaxed);
    let per_second = |counter| total(counter) as f64 / seconds;
    Ok(LoadBench {
        actors: args.actors,
        replay_servers: replay.len(),
        learners: args.learners,
        relayed: args.relay,
        seconds,
        offered_steps_per_s: crowd.steps_per_second.map(|pace| pace * args.actors as f64),
        join_seconds,
        appended_steps_per_s: per_second(&board.steps),
        appended_mb_per_s: per_second(&board.chunk_bytes) / 1e6,
        bytes_per_step: total(&board.chunk_bytes) as f64 / total(&board.steps).max(1) as f64,
        append: board.append_latency(),
        policy_bytes: args.policy_bytes,
        policy_mb_per_s: per_second(&board.policy_bytes) / 1e6,
        fan_out,
        reports_per_s: per_second(&board.reports),
        lost_reports: total(&board.lost_reports),
        sampled_steps_per_s: per_second(&board.samples),
        sampled_mb_per_s: per_second(&board.sample_bytes) / 1e6,
        commits: CommitLoad::between(before.1.into_iter().zip(after.1), seconds),
        processes: after
            .0
            .iter()
            .zip(&before.0)
            .map(|((name, after), (_, before))| after.since(before, name, seconds))
            .collect(),
    })
}

/// Episodes of the configuration's environment, cut and encoded as actors do.
fn record(
    config: &Config,
    action_dim: usize,
    args: &LoadArgs,
) -> anyhow::Result<Vec<Vec<Recorded>>> {
    let steps = usize::from(args.episode_steps);
    let env = EnvConfig {
        time_limit: u32::from(args.episode_steps) + 1,
        ..config.env.clone()
    };
    let episodes = frames::episodes(&env, action_dim, args.episodes, steps)?;
    let cut = episodes.iter().map(|episode| {
        frames::chunks(episode, config.replay.chunk_steps)
            .map(|(first_step, steps)| Recorded {
                first_step,
                steps: steps.len as u32,
                ends_episode: first_step as usize + steps.len == episode.len,
                payload: codec::encode(&steps),
            })
            .collect()
    });
    Ok(cut.collect())
}

/// Waits until every actor has a durable chunk and a policy.
async fn joined(
    board: &Board,
    args: &LoadArgs,
    since: Instant,
    actors: &mut JoinSet<anyhow::Result<()>>,
) -> anyhow::Result<()> {
    loop {
        let inserting = board.inserting.load(Ordering::Relaxed);
        let informed = board.informed.load(Ordering::Relaxed);
        if inserting >= args.actors && informed >= args.actors {
            return Ok(());
        }
        ensure!(
            since.elapsed().as_secs_f64() < args.join_seconds,
            "of {} actors, {inserting} have a durable chunk and {informed} a policy after {} s; \
             raise --join-seconds or see whether the servers are up",
            args.actors,
            args.join_seconds
        );
        tokio::select! {
            () = tokio::time::sleep(Duration::from_millis(20)) => {}
            Some(ended) = actors.join_next() => {
                ended.context("an actor's task died")??;
                bail!("an actor ended before the measurement began");
            }
        }
    }
}

/// Lets this process, and those it starts, hold so many connections.
fn raise_file_limit(files: u64) -> anyhow::Result<()> {
    let mut limit = getrlimit(Resource::Nofile);
    if limit.current.is_none_or(|current| current >= files) {
        return Ok(());
    }
    limit.current = limit.maximum;
    ensure!(
        limit.current.is_none_or(|most| most >= files),
        "{files} files are needed and {} allowed; raise the limit (ulimit -Hn) or lower --actors",
        limit.current.unwrap_or_default()
    );
    setrlimit(Resource::Nofile, limit).context("cannot raise the limit on open files")
}
