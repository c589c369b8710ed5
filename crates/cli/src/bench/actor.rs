//! `isodream bench actor`: one decision of the deployed policy, from pictures to actions.

use std::time::Instant;

use clap::Args;
use isodream_core::{Config, EnvSpec};
use isodream_model::batch::preprocess;
use isodream_model::laps::cpu_time;
use isodream_model::{ActingModel, Actions};
use isodream_rpc::{Dialer, ENVIRONMENT_PATIENCE, environment_spec};
use serde::Serialize;
use tch::{Device, Kind, Tensor};

use crate::config_args::ConfigArgs;
use crate::output::print_result;

/// Options of `isodream bench actor`.
#[derive(Debug, Args)]
pub(crate) struct ActorBenchArgs {
    #[command(flatten)]
    config: ConfigArgs,
    /// Environments that one decision serves; several numbers are measured one after the other
    #[arg(long, value_delimiter = ',', default_value = "1,4,16", value_parser = clap::value_parser!(u16).range(1..))]
    environments: Vec<u16>,
    /// Decisions that are measured; the median counts
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

/// One decision for some environments.
#[derive(Debug, Serialize)]
struct ActorBench {
    environments: u16,
    threads: i32,
    latency_seconds: f64,
    cpu_seconds: f64,
    environment_steps_per_cpu_second: f64,
}

/// Runs the command.
pub(super) fn run(args: &ActorBenchArgs) -> anyhow::Result<()> {
    let config = args.config.load()?;
    let spec = environment_spec(&Dialer::default(), &config.env, ENVIRONMENT_PATIENCE)?;
    tch::set_num_threads(config.actor.threads);
    let results: Vec<ActorBench> = args
        .environments
        .iter()
        .map(|&environments| measure(&config, &spec, environments, args.steps))
        .collect();
    print_result(&results, args.json, |results| table(results))
}

fn measure(config: &Config, spec: &EnvSpec, environments: u16, steps: u32) -> ActorBench {
    let model = ActingModel::new(config, spec.action_dim, Device::Cpu);
    let count = i64::from(environments);
    let mut state = model.begin(count);
    let image = spec.image;
    let shape = [
        count,
        image.height as i64,
        image.width as i64,
        image.channels as i64,
    ];
    let pixels = Tensor::randint(256, shape, (Kind::Uint8, Device::Cpu));
    let mut executed = Tensor::zeros([count, spec.action_dim as i64], (Kind::Float, Device::Cpu));
    let is_first = vec![false; usize::from(environments)];
    let mut decide = || {
        let images = preprocess(&pixels);
        executed = model
            .step(&mut state, &images, &executed, &is_first)
            .actions(Actions::Sample);
    };
    // Warm-up: libraries choose their kernels.
    for _ in 0..5 {
        decide();
    }
    let mut latencies = Vec::new();
    let cpu_before = cpu_time();
    for _ in 0..steps {
        let begun = Instant::now();
        decide();
        latencies.push(begun.elapsed().as_secs_f64());
    }
    let cpu_seconds = (cpu_time() - cpu_before).as_secs_f64() / f64::from(steps);
    latencies.sort_by(f64::total_cmp);
    ActorBench {
        environments,
        threads: tch::get_num_threads(),
        latency_seconds: latencies[latencies.len() / 2],
        cpu_seconds,
        environment_steps_per_cpu_second: f64::from(environments) / cpu_seconds,
    }
}

fn table(results: &[ActorBench]) -> String {
    let mut lines = vec![format!(
        "{:>12} {:>8} {:>12} {:>12} {:>18}",
        "environments", "threads", "latency ms", "CPU ms", "steps per CPU s"
    )];
    lines.extend(results.iter().map(|result| {
        format!(
            "{:>12} {:>8} {:>12.2} {:>12.2} {:>18.0}",
            result.environments,
            result.threads,
            1e3 * result.latency_seconds,
            1e3 * result.cpu_seconds,
            result.environment_steps_per_cpu_second
        )
    }));
    lines.join("\n")
}
