//! The training loop.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use isodream_core::derive_seed;
use isodream_model::Agent;
use isodream_model::agent::Metric;
use isodream_proto::v1::learner_service_server::LearnerServiceServer;
use isodream_proto::{Identity, v1};
use isodream_rpc::{
    Policy, PolicyPublisher, PolicyService, SampleClient, SampleOptions, SampleWatch,
};
use isodream_telemetry::media::MediaFolder;
use isodream_telemetry::{MetricsWriter, ResumePoint, write_whole};
use tokio_util::sync::CancellationToken;

use crate::LearnerOptions;
use crate::beginning::Beginning;
use crate::checkpoint::{Checkpoint, Counters};
use crate::evaluations::Evaluations;
use crate::media::{Drawn, Media};
use crate::progress::Progress;
use crate::run_lock::lock_for_learner;
use crate::sampling::{BatchShape, BatchStream, StagedBatch};
use crate::saver::Saver;
use crate::service::Desk;

/// How long the loop waits for data before it looks around (shutdown, reports, reasons).
const PATIENCE: Duration = Duration::from_millis(200);

/// How often the progress is brought up to date.
const PACE_INTERVAL: Duration = Duration::from_secs(1);

/// A checkpoint is at most this old, however slow the updates are.
const CHECKPOINT_AGE: Duration = Duration::from_secs(300);

/// The metric that counts updates.
const UPDATES: &str = "train/updates";

/// Why a learner ended well.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Finished {
    /// All updates are made.
    Trained,
    /// It was told to stop; the same command goes on from the checkpoint.
    Stopped,
}

/// Trains until all updates are made or `shutdown` is cancelled, and leaves a checkpoint either way, unless the update
/// that runs then takes longer than `learner.stop_secs`.
///
/// # Errors
/// Where the port is taken, replay refuses this learner, the disk fails, no checkpoint is valid, or a loss is
/// not finite. The last good checkpoint is kept.
pub async fn run(options: LearnerOptions, shutdown: CancellationToken) -> anyhow::Result<Finished> {
    let listener = isodream_rpc::bind(&options.listen, &options.door).await?;
    let (run_lock, learner_epoch) = lock_for_learner(&options.run_dir)?;
    let config = &options.config;
    let beginning = Beginning::find(&options)?;
    // What reads a run directory, `isodream dashboard` for one, knows a run by it.
    write_whole(
        &options.run_dir.join("config.toml"),
        config.to_toml().as_bytes(),
    )?;
    let counters = beginning.counters();
    let total = config.total_updates();
    let patience = Duration::from_secs_f64(config.learner.stop_secs);
    let progress = Arc::new(Progress::new(
        counters.updates,
        total,
        counters.env_frames,
        config.env.action_repeat,
    ));
    let publisher = PolicyPublisher::default();
    let identity = Identity::new(&options.spec, config.model_hash());
    tracing::info!(
        address = %listener.local_addr().context("the listener has no address")?,
        updates = counters.updates,
        total,
        env = %options.spec,
        "learner is up"
    );

    let serving = shutdown.child_token();
    let desk = Desk {
        identity: identity.clone(),
        publisher: publisher.clone(),
        progress: progress.clone(),
    };
    let service = isodream_rpc::policy_service(desk, serving.clone());
    let router = isodream_rpc::server(&options.door)?
        .add_service(isodream_rpc::serving::<LearnerServiceServer<PolicyService<Desk>>>().await)
        .add_service(service);
    let server = tokio::spawn(isodream_rpc::serve(router, listener, serving.clone()));
    let pretrain_left = config
        .learner
        .pretrain_updates
        .saturating_sub(counters.updates);
    let sampling = SampleOptions {
        addresses: options.replay.clone(),
        identity,
        sequence_length: config.learner.batch_length as u32,
        table: config.learner.table.clone(),
        learner_epoch,
        seed: derive_seed(config.seed, &["sample", &counters.updates.to_string()]),
        prefetch: config.learner.batch_size * config.learner.prefetch_batches,
        sampled_steps: counters.sampled_steps.clone(),
        unlimited_sequences: pretrain_left * config.learner.batch_size as u64,
    };
    let client = SampleClient::start(&options.dialer, sampling)?;
    let follow = tokio::spawn(follow_replay(
        client.watch(),
        config.env.action_repeat,
        progress.clone(),
    ));
    let shape = BatchShape {
        batch_size: config.learner.batch_size,
        batch_length: config.learner.batch_length,
        spec: options.spec.clone(),
        device: options.device,
    };
    let batches = BatchStream::start(
        client,
        &shape,
        config.learner.decode_threads,
        config.learner.prefetch_batches,
    )?;
    let saver = Saver::new(
        options.run_dir.join("checkpoints"),
        config.learner.keep_checkpoints,
    );
    let media = Media::new(MediaFolder::create(&options.run_dir)?);
    let training = Training {
        media,
        evaluations: Evaluations::new(&options.run_dir),
        options,
        counters,
        batches,
        learner_epoch,
        publisher,
        progress,
        saver,
        waited: Duration::ZERO,
        first_batch: None,
    };
    let stop = shutdown.clone();
    let training = tokio::task::spawn_blocking(move || training.run(beginning, &stop));
    let finished = tokio::select! {
        finished = training => finished.context("the training thread died")?,
        () = overdue(&shutdown, patience) => {
            tracing::warn!(
                waited_secs = patience.as_secs_f64(),
                "the running update takes too long to wait for; stopped, the same command goes on from the newest checkpoint"
            );
            // The thread may still write: nobody else gets the folder before this process is gone.
            std::mem::forget(run_lock);
            Ok(Finished::Stopped)
        }
    };
    follow.abort();
    serving.cancel();
    let served = server.await.context("the learner's server died");
    // What went wrong first is what a person needs to know.
    let finished = finished?;
    served??;
    Ok(finished)
}

/// Comes when a stop has been waited for long enough.
async fn overdue(shutdown: &CancellationToken, patience: Duration) {
    shutdown.cancelled().await;
    tokio::time::sleep(patience).await;
}

/// Keeps the number of environment frames and the rates true.
async fn follow_replay(replay: SampleWatch, action_repeat: u32, progress: Arc<Progress>) {
    let mut tick = tokio::time::interval(PACE_INTERVAL);
    loop {
        tick.tick().await;
        let frames = replay.inserted_steps() * u64::from(action_repeat);
        // A server that is away since this process started counts as before.
        progress.set(|status| status.env_frames = status.env_frames.max(frames));
        progress.measure_pace();
    }
}

/// The newest checkpoint that this process handed over to be written.
struct Saved {
    updates: u64,
    at: Instant,
}

struct Training {
    options: LearnerOptions,
    media: Media,
    evaluations: Evaluations,
    counters: Counters,
    batches: BatchStream,
    learner_epoch: u64,
    publisher: PolicyPublisher,
    progress: Arc<Progress>,
    saver: Saver,
    /// Time spent waiting for data since the first batch.
    waited: Duration,
    first_batch: Option<Instant>,
}

impl Training {
    fn run(
        mut self,
        beginning: Beginning,
        shutdown: &CancellationToken,
    ) -> anyhow::Result<Finished> {
        let config = self.options.config.clone();
        if config.learner.threads > 0 {
            tch::set_num_threads(config.learner.threads);
        }
        let resumed = beginning.is_resumed();
        let mut agent = beginning.agent(&self.options)?;
        let resume = ResumePoint {
            frames: self.counters.env_frames,
            counter: UPDATES,
            count: self.counters.updates as f64,
        };
        let mut metrics = MetricsWriter::open(&self.options.run_dir, &resume)?;
        let total = config.total_updates();
        let pretrain = config.learner.pretrain_updates;
        if agent.updates() >= pretrain && resumed {
            self.publish(&agent);
        }
        let mut last = Vec::new();
        let mut saved = Saved {
            updates: agent.updates(),
            at: Instant::now(),
        };
        let trained = self.train(&mut agent, &mut metrics, &mut saved, &mut last, shutdown);
        // Whatever ended the loop, the updates made so far are kept, unless they are not numbers any more.
        read(&last)?;
        if saved.updates != agent.updates() {
            self.save(&agent)?;
        }
        self.saver.finish()?;
        trained?;
        self.write_reports(&mut metrics)?;
        show(&mut metrics, self.media.finish())?;
        metrics.flush()?;
        if agent.updates() < total {
            tracing::info!(
                updates = agent.updates(),
                "stopped; the same command goes on from here"
            );
            return Ok(Finished::Stopped);
        }
        self.progress.set(|status| status.phase = "finished".into());
        tracing::info!(updates = agent.updates(), "finished");
        Ok(Finished::Trained)
    }

    /// Makes updates until there are enough or `shutdown` is cancelled; `last` receives the newest metrics.
    fn train(
        &mut self,
        agent: &mut Agent,
        metrics: &mut MetricsWriter,
        saved: &mut Saved,
        last: &mut Vec<Metric>,
        shutdown: &CancellationToken,
    ) -> anyhow::Result<()> {
        let config = self.options.config.clone();
        let learner = &config.learner;
        while agent.updates() < config.total_updates() && !shutdown.is_cancelled() {
            self.saver.poll()?;
            let drawn = self.media.drawn();
            show(metrics, drawn)?;
            let Some(batch) = self.next_batch(metrics)? else {
                continue;
            };
            let pretraining = agent.updates() < learner.pretrain_updates;
            let _update =
                tracing::debug_span!("update", update = agent.updates() + 1, pretraining).entered();
            self.progress.set(|status| {
                status.phase = if pretraining {
                    "pretraining"
                } else {
                    "training"
                }
                .into();
            });
            let steps = batch.steps.to_batch(self.options.device);
            *last = tracing::debug_span!("learn").in_scope(|| agent.update(&steps));
            self.counters.updates = agent.updates();
            self.counters.sampled_steps.extend(batch.sampled_steps);
            self.counters.env_frames = self.progress.env_frames();
            let wait_share = self.wait_share();
            self.progress.set(|status| {
                status.updates = agent.updates();
                status.wait_share = wait_share;
            });
            let due = |interval: u64| agent.updates().is_multiple_of(interval);
            let publishing = agent.updates() >= learner.pretrain_updates
                && (due(learner.publish_interval) || self.publisher.newest().is_none());
            let saving = due(learner.checkpoint_interval) || saved.at.elapsed() > CHECKPOINT_AGE;
            if publishing || saving || due(learner.log_interval) {
                let values = read(last)?;
                if due(learner.log_interval) {
                    self.log(metrics, values)?;
                }
            }
            if publishing {
                self.publish(agent);
            }
            if saving {
                self.save(agent)?;
                let (frames, updates) = (self.counters.env_frames, agent.updates());
                self.media.open_loop(frames, updates, agent.world(), &steps);
                let inverse = agent.world().inverse_errors(&steps);
                let errors = [
                    ("train/inverse_seeing".to_owned(), inverse.seeing),
                    ("train/inverse_blind".to_owned(), inverse.blind),
                ];
                metrics.scalars(frames, &errors)?;
                *saved = Saved {
                    updates: agent.updates(),
                    at: Instant::now(),
                };
            }
        }
        Ok(())
    }

    /// The next batch; none if there was none yet, so that the loop can look around.
    fn next_batch(&mut self, metrics: &mut MetricsWriter) -> anyhow::Result<Option<StagedBatch>> {
        self.write_reports(metrics)?;
        let _wait = tracing::debug_span!("wait_for_batch").entered();
        let begun = Instant::now();
        let batch = self.batches.next(PATIENCE)?;
        match self.first_batch {
            Some(_) => self.waited += begun.elapsed(),
            // Until there is experience at all, nothing waits in vain.
            None => self.first_batch = batch.is_some().then(Instant::now),
        }
        if batch.is_none() {
            let why = self.batches.waiting().unwrap_or_else(|| "decoding".into());
            self.progress
                .set(|status| status.phase = format!("waiting for data: {why}"));
        }
        Ok(batch)
    }

    fn wait_share(&self) -> f64 {
        self.first_batch.map_or(0.0, |first| {
            self.waited.as_secs_f64() / first.elapsed().as_secs_f64()
        })
    }

    fn publish(&self, agent: &Agent) {
        let _publish = tracing::debug_span!("publish_policy").entered();
        let version = v1::PolicyVersion {
            learner_epoch: self.learner_epoch,
            version: agent.updates(),
        };
        self.publisher
            .publish(Policy::new(version, agent.publish()));
        self.progress.set(|status| status.policy = Some(version));
    }

    /// Hands a copy of everything to the saver.
    fn save(&mut self, agent: &Agent) -> anyhow::Result<()> {
        self.saver.save(Checkpoint {
            counters: self.counters.clone(),
            env_spec: self.options.spec.to_string(),
            config: self.options.config.clone(),
            model: agent.save_model(),
            optimizer: agent.save_optimizer(),
        })
    }

    fn log(
        &self,
        metrics: &mut MetricsWriter,
        mut values: Vec<(String, f64)>,
    ) -> anyhow::Result<()> {
        let status = self.progress.status();
        values.extend([
            (UPDATES.to_owned(), status.updates as f64),
            ("train/wait_share".to_owned(), status.wait_share),
            ("fps/env".to_owned(), status.env_frames_per_s),
            (
                "fps/train".to_owned(),
                status.updates_per_s * self.options.config.batch_steps() as f64,
            ),
            (
                "replay/sampled_steps".to_owned(),
                self.counters.sampled_steps.values().sum::<u64>() as f64,
            ),
        ]);
        metrics.scalars(self.counters.env_frames, &values)?;
        Ok(())
    }

    /// Writes the episodes that actors reported: `episode/*` of collecting, `eval/*` and `probe/*` of evaluating ones.
    fn write_reports(&mut self, metrics: &mut MetricsWriter) -> anyhow::Result<()> {
        let frames = self.progress.env_frames();
        for report in self.progress.take_reports() {
            let (prefix, probed) = match report.role() {
                v1::ActorRole::Evaluate => {
                    self.media.episode(frames, &report);
                    self.evaluations.add(frames, &report)?;
                    ("eval", self.media.probe(frames, &report))
                }
                _ => ("episode", Vec::new()),
            };
            let mut values = vec![
                (format!("{prefix}/score"), report.score),
                (format!("{prefix}/length"), f64::from(report.length)),
            ];
            values.extend(
                report
                    .metrics
                    .into_iter()
                    .map(|(name, value)| (format!("{prefix}/{name}"), value)),
            );
            values.extend(probed);
            metrics.scalars(frames, &values)?;
        }
        Ok(())
    }
}

/// Hands a panel to those who look at metrics.
fn show(metrics: &mut MetricsWriter, drawn: Option<Drawn>) -> anyhow::Result<()> {
    let Some(drawn) = drawn else { return Ok(()) };
    let frames = drawn.facts.frames;
    metrics.scalars(frames, &[("open_loop/error", drawn.error())])?;
    metrics.image(frames, "open_loop/still", &drawn.still)?;
    metrics.animation(frames, "open_loop/moving", &drawn.moving)?;
    Ok(())
}

/// Reads metrics from the device and refuses numbers that are none.
fn read(measured: &[Metric]) -> anyhow::Result<Vec<(String, f64)>> {
    let values: Vec<(String, f64)> = measured
        .iter()
        .map(|(name, tensor)| ((*name).to_owned(), tensor.double_value(&[])))
        .collect();
    if let Some((name, value)) = values.iter().find(|(_, value)| !value.is_finite()) {
        bail!(
            "{name} is {value}: training diverged; the last checkpoint is kept, lower the learning rates in [optimizer]"
        );
    }
    Ok(values)
}
