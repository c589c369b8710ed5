//! `isodream bench learner`: seconds per training step.

use anyhow::ensure;
use clap::Args;
use isodream_core::Config;
use isodream_model::cost::UpdateCost;
use isodream_model::laps::{Lap, Laps};
use isodream_model::precision::product_kind;
use isodream_model::{Agent, Batch};
use isodream_rpc::{Dialer, ENVIRONMENT_PATIENCE, environment_spec};
use serde::Serialize;
use tch::{Device, Kind, Tensor};

use super::machine;
use crate::config_args::ConfigArgs;
use crate::output::print_result;
use crate::roles::DeviceArg;

/// Options of `isodream bench learner`.
#[derive(Debug, Args)]
pub(crate) struct LearnerBenchArgs {
    #[command(flatten)]
    pub(crate) config: ConfigArgs,
    /// Sequences per batch; the configuration's by default
    #[arg(long)]
    batch: Option<usize>,
    /// Steps per sequence; the configuration's by default
    #[arg(long)]
    length: Option<usize>,
    /// Steps that are measured; the fastest counts
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// In which numbers to multiply: fp32, bf16 or auto; the configuration's by default
    #[arg(long)]
    dtype: Option<String>,
    /// Where to compute
    #[arg(long, value_enum, default_value_t = DeviceArg::Cpu)]
    device: DeviceArg,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct LearnerBench {
    device: String,
    dtype: &'static str,
    threads: i32,
    batch: usize,
    length: usize,
    workers: usize,
    steps: u32,
    /// Frames of the batch over the seconds of a step.
    replayed_frames_per_s: f64,
    wall_seconds_per_step: f64,
    cpu_seconds_per_step: f64,
    flops_per_step: f64,
    gflops: f64,
    /// Of the rate of matrix products in the same numbers.
    gemm_share: f64,
    gemm_gflops_fp32: f64,
    gemm_gflops_bf16: f64,
    peak_rss_bytes: u64,
    phases: Vec<Phase>,
}

#[derive(Debug, Serialize)]
struct Phase {
    name: &'static str,
    wall_seconds: f64,
    cpu_seconds: f64,
    flops: f64,
    /// Of the rate of matrix products in the benchmark's numbers.
    gemm_share: f64,
}

/// Runs the command.
pub(super) fn run(args: &LearnerBenchArgs) -> anyhow::Result<()> {
    let mut settings = args.config.clone();
    settings.set.extend(
        args.dtype
            .iter()
            .map(|dtype| format!("learner.precision={dtype}")),
    );
    let mut config = settings.load()?;
    config.learner.batch_size = args.batch.unwrap_or(config.learner.batch_size);
    config.learner.batch_length = args.length.unwrap_or(config.learner.batch_length);
    config.behavior.warmup_updates = 0;
    let (batch, length) = (config.learner.batch_size, config.learner.batch_length);
    ensure!(
        batch > 0 && length as i64 >= config.model.background_frames.max(2),
        "--batch {batch} --length {length}: a batch needs a sequence, and a sequence the {} frames of the static branch",
        config.model.background_frames
    );
    let device = args.device.resolve()?;
    if config.learner.threads > 0 {
        tch::set_num_threads(config.learner.threads);
    }
    let result = measure(&config, args.steps, device)?;
    print_result(&result, args.json, LearnerBench::table)
}

fn measure(config: &Config, steps: u32, device: Device) -> anyhow::Result<LearnerBench> {
    let spec = environment_spec(&Dialer::default(), &config.env, ENVIRONMENT_PATIENCE)?;
    let mut agent = Agent::new(config, &spec, device);
    let batch = random_batch(config, spec.action_dim as i64, device);
    // Warm-up: libraries choose their kernels and allocators fill.
    agent.update(&batch);
    let mut fastest: Option<(Lap, Vec<(&'static str, Lap)>)> = None;
    for _ in 0..steps {
        let mut laps = Laps::start(device);
        agent.measured_update(&batch, &mut laps);
        laps.lap("rest");
        let total = laps
            .phases()
            .iter()
            .fold(Lap::default(), |sum, (_, lap)| Lap {
                wall: sum.wall + lap.wall,
                cpu: sum.cpu + lap.cpu,
            });
        if fastest
            .as_ref()
            .is_none_or(|(best, _)| total.wall < best.wall)
        {
            fastest = Some((total, laps.phases().to_vec()));
        }
    }
    let (total, phases) = fastest.expect("at least one step is measured");
    let peak_rss_bytes = machine::peak_rss_bytes()?;
    let cost = UpdateCost::new(config, spec.action_dim);
    let flops = cost.total();
    let gemm_gflops_fp32 = machine::gemm_gflops(Kind::Float, device);
    let gemm_gflops_bf16 = machine::gemm_gflops(Kind::BFloat16, device);
    let (dtype, gemm_gflops) = match product_kind(config.learner.precision, device) {
        Kind::BFloat16 => ("bf16", gemm_gflops_bf16),
        _ => ("fp32", gemm_gflops_fp32),
    };
    let phases = phases.into_iter().map(|(name, lap)| Phase {
        name,
        wall_seconds: lap.wall,
        cpu_seconds: lap.cpu,
        flops: cost.of(name),
        gemm_share: cost.of(name) / lap.wall / 1e9 / gemm_gflops,
    });
    Ok(LearnerBench {
        device: format!("{device:?}"),
        dtype,
        threads: tch::get_num_threads(),
        batch: config.learner.batch_size,
        length: config.learner.batch_length,
        workers: config.learner.workers,
        steps,
        replayed_frames_per_s: config.batch_steps() as f64 / total.wall,
        wall_seconds_per_step: total.wall,
        cpu_seconds_per_step: total.cpu,
        flops_per_step: flops,
        gflops: flops / total.wall / 1e9,
        gemm_share: flops / total.wall / 1e9 / gemm_gflops,
        gemm_gflops_fp32,
        gemm_gflops_bf16,
        peak_rss_bytes,
        phases: phases.collect(),
    })
}

/// Random pixels and actions: the work does not depend on what is in a picture.
fn random_batch(config: &Config, action_dim: i64, device: Device) -> Batch {
    let (batch, length) = (
        config.learner.batch_size as i64,
        config.learner.batch_length as i64,
    );
    let side = config.env.image_size as i64;
    let float = (Kind::Float, device);
    let pixels = Tensor::randint(256, [batch * length, side, side, 3], (Kind::Uint8, device));
    let actions = Tensor::rand([batch, length, action_dim], float) * 2.0 - 1.0;
    Batch {
        images: isodream_model::batch::preprocess(&pixels).unflatten(0, [batch, length]),
        rewards: actions.select(2, 0),
        discounts: Tensor::ones([batch, length], float),
        actions,
    }
}

impl LearnerBench {
    fn table(&self) -> String {
        let mut lines = vec![format!(
            "{} x {} on {} with {} threads for each of {} workers, {}: {:.3} s, {:.3} CPU s per step, {:.0} frames/s",
            self.batch,
            self.length,
            self.device,
            self.threads,
            self.workers,
            self.dtype,
            self.wall_seconds_per_step,
            self.cpu_seconds_per_step,
            self.replayed_frames_per_s
        )];
        lines.push(format!(
            "{:.0} GFLOP/s; matrix products here: {:.0} in fp32, {:.0} in bf16; peak memory {:.2} GB",
            self.gflops,
            self.gemm_gflops_fp32,
            self.gemm_gflops_bf16,
            self.peak_rss_bytes as f64 / 1e9
        ));
        lines.push(format!(
            "{:<24} {:>8} {:>8} {:>8} {:>12}",
            "phase", "wall s", "CPU s", "GFLOP", "of products"
        ));
        let row = |name: &str, wall: f64, cpu: f64, flops: f64, share: f64| {
            format!(
                "{name:<24} {wall:>8.3} {cpu:>8.3} {:>8.1} {:>10.0} %",
                flops / 1e9,
                1e2 * share
            )
        };
        lines.extend(self.phases.iter().map(|phase| {
            row(
                phase.name,
                phase.wall_seconds,
                phase.cpu_seconds,
                phase.flops,
                phase.gemm_share,
            )
        }));
        lines.push(row(
            "all",
            self.wall_seconds_per_step,
            self.cpu_seconds_per_step,
            self.flops_per_step,
            self.gemm_share,
        ));
        lines.join("\n")
    }
}
