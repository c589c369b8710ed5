//! `chaos ledger-actor`: an actor without an environment that writes down what it was promised.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use clap::Args;
use isodream_core::{Chunk, EnvSpec, Step, Steps, codec, derive_seed};
use isodream_proto::Identity;
use isodream_rpc::limits::FAILOVER_AFTER;
use isodream_rpc::{AppendClient, AppendOptions, Role, environment_spec, shutdown_on_signal};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio_util::sync::CancellationToken;

use crate::ledger::LedgerFile;
use crate::secrets;
use crate::settings::Settings;

/// Pause between two chunks of a lane: real actors shall have their share of the learner's pace.
const PAUSE: Duration = Duration::from_millis(20);

/// How long a replay-server may take for what it still owes when the actor is told to stop.
const FLUSH_DEADLINE: Duration = Duration::from_secs(10);

/// Options of `chaos ledger-actor`.
#[derive(Debug, Args)]
pub(crate) struct LedgerActorArgs {
    #[command(flatten)]
    settings: Settings,
    /// Name; its lanes are NAME-0, NAME-1 and so on
    #[arg(long)]
    id: String,
    /// Append streams
    #[arg(long)]
    lanes: usize,
    /// The replay-servers
    #[arg(long, value_delimiter = ',')]
    replay: Vec<String>,
    /// Folder made by `isodream secrets`
    #[arg(long, env = "ISODREAM_SECRETS")]
    secrets: Option<PathBuf>,
    /// The file that grows by a line for each acknowledged chunk
    #[arg(long)]
    ledger: PathBuf,
}

/// Appends until it is told to stop, or its standard input closes.
pub(crate) async fn run(args: LedgerActorArgs) -> Result<()> {
    let config = args.settings.load()?;
    let (env, dialer) = (
        config.env.clone(),
        secrets::dialer(args.secrets.as_deref(), Role::Actor)?,
    );
    let asking = dialer.clone();
    let spec = tokio::task::spawn_blocking(move || environment_spec(&asking, &env, FLUSH_DEADLINE))
        .await??;
    let shutdown = shutdown_on_signal()?;
    stop_with_parent(&shutdown)?;
    let ledger = Arc::new(LedgerFile::open(&args.ledger)?);
    let mut lanes = tokio::task::JoinSet::new();
    for lane in 0..args.lanes {
        let actor_id = format!("{}-{lane}", args.id);
        let client = AppendClient::start(
            &dialer,
            AppendOptions {
                addresses: args.replay.clone(),
                identity: Identity::new(&spec, ""),
                actor_id: actor_id.clone(),
                spool_chunks: config.actor.spool_chunks,
                spool_bytes: config.actor.spool_mb << 20,
                failover_after: FAILOVER_AFTER,
            },
        )?;
        client.observe(ledger.clone());
        let lane = Lane {
            spec: spec.clone(),
            actor_id,
            entropy: rand::rng().random(),
            chunk_steps: config.replay.chunk_steps as u32,
            client,
        };
        lanes.spawn(lane.run(shutdown.clone()));
    }
    while let Some(ended) = lanes.join_next().await {
        ended.context("a lane died")??;
    }
    Ok(())
}

/// Reads standard input to its end, which is when the process that started this one is gone.
fn stop_with_parent(shutdown: &CancellationToken) -> Result<()> {
    let cancelled = shutdown.clone();
    std::thread::Builder::new()
        .name("supervision".into())
        .spawn(move || {
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            cancelled.cancel();
        })?;
    Ok(())
}

/// One append stream.
struct Lane {
    spec: EnvSpec,
    actor_id: String,
    /// Names the episodes of this process.
    entropy: u64,
    chunk_steps: u32,
    client: AppendClient,
}

impl Lane {
    async fn run(self, shutdown: CancellationToken) -> Result<()> {
        let sending = async {
            for episode in 0_u64.. {
                self.episode(episode).await?;
            }
            Ok(())
        };
        let ended = tokio::select! {
            ended = sending => ended,
            () = shutdown.cancelled() => {
                self.client.close();
                Ok(())
            }
        };
        // What is not acknowledged by then is in no ledger.
        if ended.is_ok()
            && let Err(error) = self.client.flush(FLUSH_DEADLINE).await
        {
            eprintln!("{}: {error}", self.actor_id);
        }
        ended
    }

    async fn episode(&self, number: u64) -> Result<()> {
        let episode_id = derive_seed(
            self.entropy,
            &["ledger", &self.actor_id, &number.to_string()],
        );
        let rows = self.spec.time_limit + 1;
        let mut first_step = 0;
        while first_step < rows {
            let steps = self.chunk_steps.min(rows - first_step);
            let chunk = Chunk {
                actor_id: String::new(),
                epoch: 0,
                seq: 0,
                episode_id,
                first_step,
                steps,
                ends_episode: first_step + steps == rows,
                payload: codec::encode(&self.steps(episode_id, first_step, steps, rows)),
            };
            self.client.send(chunk).await?;
            first_step += steps;
            tokio::time::sleep(PAUSE).await;
        }
        Ok(())
    }

    /// Rows that no other chunk has: an evenly coloured picture with a line of noise.
    fn steps(&self, episode_id: u64, first_step: u32, count: u32, rows: u32) -> Steps {
        let mut random = ChaCha8Rng::seed_from_u64(episode_id ^ u64::from(first_step) << 32);
        let mut steps = Steps::new(self.spec.image.bytes(), self.spec.action_dim);
        for row in first_step..first_step + count {
            let mut image = vec![random.random(); self.spec.image.bytes()];
            for byte in image.iter_mut().take(64) {
                *byte = random.random();
            }
            steps.push(&Step {
                image,
                action: vec![random.random_range(-1.0..1.0); self.spec.action_dim],
                reward: if row == 0 { 0.0 } else { random.random() },
                discount: 1.0,
                is_first: row == 0,
                is_last: row + 1 == rows,
                is_terminal: false,
            });
        }
        steps
    }
}
