//! `isodream eval`: a trained policy beside scripted drivers, all on the same seeds.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::Args;
use isodream_actor::AgentPolicy;
use isodream_actor::rollout::{Outcome, Pilot, episode};
use isodream_core::derive_seed;
use isodream_envs::ScriptedDriver;
use isodream_learner::checkpoint::Checkpoint;
use isodream_model::Actions;
use isodream_rpc::{Dialer, Role};
use serde::Serialize;

use crate::output::print_result;
use crate::security::ClientArgs;

/// Options of `isodream eval`.
#[derive(Debug, Args)]
pub(crate) struct EvalArgs {
    /// A run directory or a checkpoint folder
    #[arg(long)]
    checkpoint: PathBuf,
    /// Episodes per policy
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Evaluate under other settings than the run's, for example env.id=dmc/walker_walk/video_hard; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    security: ClientArgs,
}

/// What one policy came to.
#[derive(Debug, Serialize)]
pub(crate) struct PolicyResult {
    return_mean: f64,
    return_std: f64,
    collisions_mean: f64,
    distance_m_mean: f64,
    length_mean: f64,
    returns: Vec<f64>,
    end_reasons: BTreeMap<String, usize>,
}

/// All policies on the same seeds.
#[derive(Debug, Serialize)]
pub(crate) struct Evaluation {
    env: String,
    episodes: u64,
    updates: u64,
    env_frames: u64,
    policies: BTreeMap<String, PolicyResult>,
}

/// Runs the command.
pub(crate) fn run(args: &EvalArgs) -> anyhow::Result<()> {
    let dialer = args.security.dialer(Role::Actor)?;
    let evaluation = evaluate(&dialer, &args.checkpoint, &args.set, args.episodes, &|| {
        true
    })?;
    print_result(&evaluation, args.json, Evaluation::table)
}

/// Evaluates the newest checkpoint in `path`, with some settings changed by `set`.
///
/// # Errors
/// Where there is no checkpoint, the environment fails, or `go_on` says no.
pub(crate) fn evaluate(
    dialer: &Dialer,
    path: &Path,
    set: &[String],
    episodes: u64,
    go_on: &dyn Fn() -> bool,
) -> anyhow::Result<Evaluation> {
    let checkpoint = Checkpoint::find(path)?;
    let config = &checkpoint.config.with(set)?;
    let mut env = isodream_rpc::open_environment(dialer, &config.env)?;
    let spec = env.spec().clone();
    tch::manual_seed(derive_seed(config.seed, &["eval", "noise"]) as i64);
    let mut agent = AgentPolicy::new(config, &spec, 1, &checkpoint.model)
        .context("the checkpoint does not fit its own configuration")?;
    let seeds: Vec<u64> = (0..episodes)
        .map(|i| derive_seed(config.seed, &["eval", &i.to_string()]))
        .collect();

    let mut policies = BTreeMap::new();
    let mut outcomes = Vec::new();
    for &seed in &seeds {
        let mut pilot = Pilot::Agent(&mut agent, Actions::Mode);
        outcomes.push(episode(env.as_mut(), &mut pilot, seed, go_on, &mut |_| {})?);
    }
    policies.insert("trained".to_owned(), PolicyResult::new(&outcomes));
    // Where nobody may look at the world itself, random actions are the only yardstick.
    let drivers: &[ScriptedDriver] = match env.privileged() {
        Some(_) => &ScriptedDriver::ALL,
        None => &[ScriptedDriver::Random],
    };
    for scripted in drivers {
        let mut outcomes = Vec::new();
        for &seed in &seeds {
            let mut driver = scripted.driver(seed);
            let mut pilot = Pilot::Driver(driver.as_mut());
            outcomes.push(episode(env.as_mut(), &mut pilot, seed, go_on, &mut |_| {})?);
        }
        policies.insert(scripted.as_str().to_owned(), PolicyResult::new(&outcomes));
    }
    ensure!(
        go_on(),
        "the evaluation was interrupted; isodream eval makes it again"
    );
    Ok(Evaluation {
        env: spec.to_string(),
        episodes,
        updates: checkpoint.counters.updates,
        env_frames: checkpoint.counters.env_frames,
        policies,
    })
}

impl PolicyResult {
    fn new(outcomes: &[Outcome]) -> Self {
        let count = outcomes.len().max(1) as f64;
        let mean =
            |value: &dyn Fn(&Outcome) -> f64| outcomes.iter().map(value).sum::<f64>() / count;
        let metric = |name: &'static str| {
            mean(&|o: &Outcome| o.metrics.get(name).copied().unwrap_or(f64::NAN))
        };
        let return_mean = mean(&|o| o.score);
        let mut end_reasons = BTreeMap::new();
        for reason in outcomes.iter().filter_map(|o| o.end_reason) {
            *end_reasons.entry(reason.to_string()).or_default() += 1;
        }
        Self {
            return_mean,
            return_std: mean(&|o| (o.score - return_mean).powi(2)).sqrt(),
            collisions_mean: metric("collisions"),
            distance_m_mean: metric("distance_m"),
            length_mean: mean(&|o| f64::from(o.length)),
            returns: outcomes.iter().map(|o| o.score).collect(),
            end_reasons,
        }
    }
}

impl Evaluation {
    /// For people.
    pub(crate) fn table(&self) -> String {
        let mut text = format!(
            "{} episodes of {} after {} updates, {} environment frames\n{:<12} {:>18} {:>11} {:>12} {:>8}\n",
            self.episodes,
            self.env,
            self.updates,
            self.env_frames,
            "policy",
            "return",
            "collisions",
            "distance m",
            "length"
        );
        let names = ScriptedDriver::ALL.map(ScriptedDriver::as_str);
        for name in ["trained"].into_iter().chain(names) {
            let Some(result) = self.policies.get(name) else {
                continue;
            };
            let score = format!("{:.1} +- {:.1}", result.return_mean, result.return_std);
            // What the environment does not measure stays empty.
            let measured = |value: f64, digits: usize| match value.is_nan() {
                true => "-".to_owned(),
                false => format!("{value:.digits$}"),
            };
            text += &format!(
                "{name:<12} {score:>18} {:>11} {:>12} {:>8.0}\n",
                measured(result.collisions_mean, 1),
                measured(result.distance_m_mean, 0),
                result.length_mean
            );
        }
        text
    }
}
