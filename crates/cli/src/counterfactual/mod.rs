//! `isodream imagine --counterfactual`: how well the model foretells what other actions would bring.

mod picture;

use std::fmt::Write as _;

use anyhow::{Context, bail, ensure};
use isodream_actor::AgentPolicy;
use isodream_actor::probe::{Episode, Extent, Finding, States, probe};
use isodream_actor::rollout::{Pilot, episode};
use isodream_core::derive_seed;
use isodream_learner::checkpoint::Checkpoint;
use isodream_model::{Actions, RewardModel};
use isodream_rpc::Role;
use isodream_telemetry::probe::{Probe, ProbeReport, ProbeScores};
use isodream_telemetry::write_whole;

use crate::imagine::ImagineArgs;
use crate::output::print;

/// Runs the command.
pub(crate) fn run(args: &ImagineArgs) -> anyhow::Result<()> {
    let probe = compare(args)?;
    let report = probe.report();
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot create {}", args.out.display()))?;
    let json = serde_json::to_string_pretty(&report)?;
    write_whole(&args.out.join("counterfactual.json"), json.as_bytes())?;
    picture::scatter(&probe, &report).save_png(&args.out.join("counterfactual.png"))?;
    tracing::info!(folder = %args.out.display(), "wrote counterfactual.json and counterfactual.png");
    print(if args.json { json } else { table(&report) }.trim_end())
}

/// Drives on held-out seeds by the mode and probes the model at states of these episodes.
fn compare(args: &ImagineArgs) -> anyhow::Result<Probe> {
    let checkpoint = Checkpoint::find(&args.checkpoint)?;
    let config = &checkpoint.config;
    let mut env = isodream_rpc::open_environment(&args.security.dialer(Role::Actor)?, &config.env)?;
    let spec = env.spec().clone();
    // One picture at a time is slower on several threads.
    tch::set_num_threads(config.actor.threads);
    tch::manual_seed(derive_seed(config.seed, &["imagine", "noise"]) as i64);
    let mut agent = AgentPolicy::new(config, &spec, 1, &checkpoint.model)?;
    let reward = RewardModel::new(config, &checkpoint.model)?;

    let mut episodes = Vec::new();
    for index in 0..args.episodes {
        let seed = derive_seed(config.seed, &["imagine", &index.to_string()]);
        let mut kept = Episode::new(seed);
        let mut pilot = Pilot::Agent(&mut agent, Actions::Mode);
        episode(env.as_mut(), &mut pilot, seed, &|| true, &mut |moment| {
            kept.take(moment);
        })?;
        episodes.push(kept);
    }
    let extent = Extent {
        states: States::PerKind(args.states as usize),
        horizon: args.horizon as usize,
        latest: usize::MAX,
        seed: derive_seed(config.seed, &["probe"]),
    };
    ensure!(!episodes.is_empty(), "without --episodes there is no state");
    match probe(
        env.as_mut(),
        &mut agent,
        &reward,
        &episodes,
        extent,
        &|| true,
    )? {
        Finding::Compared(probe) => Ok(probe),
        Finding::TooShort => bail!(
            "none of {} episodes is long enough for a plan of {} steps; give more --episodes or a shorter --horizon",
            args.episodes,
            args.horizon
        ),
        Finding::Unrepeatable => bail!(
            "{} shows something else when the same seed and actions come again, so that nothing can be compared",
            spec.id
        ),
        Finding::Stopped => bail!("the comparison was interrupted"),
    }
}

/// For people.
fn table(report: &ProbeReport) -> String {
    let number = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2}"));
    let mut text = format!(
        "How well the model ranks what would happen under other actions: 1 is perfect, 0 is guessing.\n\
         Returns are sums of rewards over {} steps.\n\n\
         {:<10} {:>7} {:>17} {:>12} {:>6} {:>6} {:>6}\n",
        report.horizon,
        "states",
        "number",
        "rank correlation",
        "correlation",
        "slope",
        "bias",
        "rmse"
    );
    let rows = || {
        let kinds = report
            .kinds
            .iter()
            .map(|(kind, scores)| (&kind[..], scores));
        let kinds = kinds.filter(|(kind, _)| *kind != "all");
        std::iter::once(("all", &report.all)).chain(kinds)
    };
    for (name, scores) in rows() {
        let _ = writeln!(
            text,
            "{name:<10} {:>7} {:>17} {:>12} {:>6} {:>6.2} {:>6.2}",
            scores.states,
            number(scores.rank_correlation),
            number(scores.correlation),
            number(scores.calibration_slope),
            scores.bias,
            scores.rmse
        );
    }
    let _ = write!(text, "\nmean return, real / imagined\n{:<20}", "plan");
    for (name, _) in rows() {
        let _ = write!(text, " {name:>15}");
    }
    for (index, plan) in report.plans.iter().enumerate() {
        let _ = write!(text, "\n{plan:<20}");
        for (_, scores) in rows() {
            let _ = write!(text, " {:>15}", pair(scores, index));
        }
    }
    text
}

fn pair(scores: &ProbeScores, plan: usize) -> String {
    format!("{:.2} / {:.2}", scores.real[plan], scores.imagined[plan])
}
