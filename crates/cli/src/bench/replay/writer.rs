//! An actor's sending side: cuts episodes into chunks, encodes them on one thread and hands them over.

use std::time::{Duration, Instant};

use isodream_core::{Chunk, Steps, codec};
use isodream_rpc::limits::FAILOVER_AFTER;
use isodream_rpc::{AppendClient, AppendOptions, Dialer};

use super::part::{Done, Work, answer};
use super::probes;
use crate::bench::frames;

/// Longer than any disk takes for a spool.
const FLUSH_DEADLINE: Duration = Duration::from_secs(60);

pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    let episodes = work.record()?;
    let runtime = tokio::runtime::Runtime::new()?;
    let client = {
        let _inside = runtime.enter();
        AppendClient::start(
            &Dialer::default(),
            AppendOptions {
                addresses: vec![work.address.clone()],
                identity: work.identity(&work.spec()?),
                actor_id: "bench".to_owned(),
                spool_chunks: work.spool_chunks,
                spool_bytes: usize::MAX,
                failover_after: FAILOVER_AFTER,
            },
        )?
    };
    let mut sources = episodes.iter().cycle();
    let mut episode_id = 0;
    answer(&"ready", |seconds| {
        let until = Duration::from_secs_f64(seconds.parse()?);
        let cpu_before = probes::cpu_seconds();
        let begun = Instant::now();
        let mut steps = 0;
        while begun.elapsed() < until {
            let Some(episode) = sources.next() else { break };
            episode_id += 1;
            send(&client, episode, episode_id, work.chunk_steps)?;
            steps += episode.len as u64;
        }
        runtime.block_on(client.flush(FLUSH_DEADLINE))?;
        Ok(Done {
            steps,
            seconds: begun.elapsed().as_secs_f64(),
            cpu_seconds: probes::cpu_seconds() - cpu_before,
        })
    })
}

fn send(
    client: &AppendClient,
    episode: &Steps,
    episode_id: u64,
    chunk_steps: usize,
) -> anyhow::Result<()> {
    for (first_step, steps) in frames::chunks(episode, chunk_steps) {
        client.send_blocking(Chunk {
            actor_id: String::new(),
            epoch: 0,
            seq: 0,
            episode_id,
            first_step,
            steps: steps.len as u32,
            ends_episode: first_step as usize + steps.len == episode.len,
            payload: codec::encode(&steps),
        })?;
    }
    Ok(())
}
