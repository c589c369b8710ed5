//! `isodream imagine`: open-loop prediction as pictures, and how well the branches separate in numbers.

use std::ops::Range;
use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Args;
use isodream_actor::AgentPolicy;
use isodream_actor::rollout::{Pilot, record};
use isodream_core::{Steps, derive_seed};
use isodream_envs::class;
use isodream_learner::checkpoint::Checkpoint;
use isodream_learner::panel::Panel;
use isodream_model::Actions;
use isodream_model::agent::Agent;
use isodream_model::batch::StagedSteps;
use isodream_model::gate_evidence::{GateEvidence, gate_evidence};
use isodream_model::open_loop::{OpenLoop, open_loop};
use isodream_rpc::Role;
use isodream_telemetry::{write_mp4, write_whole};
use serde::Serialize;
use tch::{Device, Kind, Tensor};

use crate::output::print;
use crate::security::ClientArgs;

/// Frames with observations before the prediction begins, as in the paper.
const CONTEXT: i64 = 5;
/// Frames of a sequence, as in the paper.
const LENGTH: usize = 50;

/// Options of `isodream imagine`.
#[derive(Debug, Args)]
pub(crate) struct ImagineArgs {
    /// A run directory or a checkpoint folder
    #[arg(long)]
    pub(crate) checkpoint: PathBuf,
    /// Where the pictures go
    #[arg(long, default_value = "imagine")]
    pub(crate) out: PathBuf,
    /// Episodes on held-out seeds; the first one is drawn
    #[arg(long, default_value_t = 8)]
    pub(crate) episodes: u64,
    /// Instead, hold several plans of actions at states that the policy meets, and compare what really follows, by
    /// repeating the episodes, with what the model imagines
    #[arg(long)]
    counterfactual: bool,
    /// States of each kind
    #[arg(long, default_value_t = 24, requires = "counterfactual", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) states: u32,
    /// Steps of a plan
    #[arg(long, default_value_t = 15, requires = "counterfactual", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) horizon: u32,
    /// Print the comparison as JSON instead of a table
    #[arg(long, requires = "counterfactual")]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) security: ClientArgs,
}

/// How much of each branch's mask lies on the vehicles that the simulator knows of.
#[derive(Debug, Serialize)]
struct Separation {
    /// Pixels that show other vehicles, of all.
    vehicle_share: f64,
    /// Squared error of the pictures on those pixels, over that of the static branch alone: 0 is a perfect picture of the
    /// vehicles, 1 one without them.
    vehicle_error: f64,
    controllable: MaskRatio,
    noncontrollable: MaskRatio,
}

/// A branch's mean mask inside and outside true vehicle pixels.
#[derive(Debug, Serialize)]
struct MaskRatio {
    inside: f64,
    outside: f64,
    ratio: f64,
}

#[derive(Debug, Serialize)]
struct Report {
    sequences: usize,
    /// Latents from observations throughout; none where the environment shows no vehicles, or does not tell which
    /// pixels they are.
    reconstruction: Option<Separation>,
    /// Latents from observations for the context, then from actions alone.
    open_loop: Option<Separation>,
    /// Whether the dependency gate opens on interactions; none without a gate.
    gate: Option<GateEvidence>,
    /// Mean absolute pixel error of the open-loop prediction, in 1/255.
    open_loop_error: f64,
}

/// Runs the command.
pub(crate) fn run(args: &ImagineArgs) -> anyhow::Result<()> {
    if args.counterfactual {
        return crate::counterfactual::run(args);
    }
    let checkpoint = Checkpoint::find(&args.checkpoint)?;
    let config = &checkpoint.config;
    let mut env = isodream_rpc::open_environment(&args.security.dialer(Role::Actor)?, &config.env)?;
    let spec = env.spec().clone();
    tch::manual_seed(derive_seed(config.seed, &["imagine", "noise"]) as i64);
    let mut driver = AgentPolicy::new(config, &spec, 1, &checkpoint.model)?;
    let mut agent = Agent::new(config, &spec, Device::Cpu);
    agent.load(
        &checkpoint.model,
        &checkpoint.optimizer,
        checkpoint.counters.updates,
    )?;

    let mut sequences = Vec::new();
    let mut classes = Vec::new();
    let mut interactions = Vec::new();
    for index in 0..args.episodes {
        let seed = derive_seed(config.seed, &["imagine", &index.to_string()]);
        let mut pilot = Pilot::Agent(&mut driver, Actions::Sample);
        let (_, recording) = record(env.as_mut(), &mut pilot, seed)?;
        if let Some(rows) = window(recording.steps.len) {
            let all = &recording.steps;
            let mut steps = Steps::new(all.image_bytes, all.action_dim);
            steps.extend(all, rows.clone());
            sequences.push(steps);
            let pixels = recording.classes.len() / all.len;
            classes.extend(&recording.classes[rows.start * pixels..rows.end * pixels]);
            let happened = recording.interactions[rows].iter();
            interactions.extend(happened.map(|&happened| f32::from(u8::from(happened))));
        }
    }
    ensure!(
        !sequences.is_empty(),
        "none of {} episodes lasted {LENGTH} steps; give more --episodes or train longer",
        args.episodes
    );
    let side = config.env.image_size as i64;
    let batch =
        StagedSteps::new(&sequences, config.env.image_size, Device::Cpu).to_batch(Device::Cpu);
    let truth = vehicles(&classes, side);
    if truth.is_none() {
        tracing::warn!("the environment tells of no vehicles, so that no separation is measured");
    }
    let reconstructed = open_loop(agent.world(), &batch, LENGTH as i64);
    let predicted = open_loop(agent.world(), &batch, CONTEXT);
    let interactions = Tensor::from_slice(&interactions).view([-1, LENGTH as i64]);
    let pictures = batch.images.flatten(0, 1);
    let error = (&predicted.composition.image - &pictures)
        .abs()
        .mean(Kind::Float);
    let report = Report {
        sequences: sequences.len(),
        reconstruction: truth
            .as_ref()
            .map(|vehicle| separation(&reconstructed, &pictures, vehicle)),
        open_loop: truth
            .as_ref()
            .map(|vehicle| separation(&predicted, &pictures, vehicle)),
        gate: gate_evidence(agent.world(), &batch, &interactions),
        open_loop_error: error.double_value(&[]) * 255.0,
    };

    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot create {}", args.out.display()))?;
    let panel = Panel::new(&batch, &predicted, CONTEXT);
    panel.still().save_png(&args.out.join("open_loop.png"))?;
    write_mp4(&args.out.join("open_loop.mp4"), panel.video(), Panel::FPS)?;
    let text = serde_json::to_string_pretty(&report)?;
    write_whole(&args.out.join("separation.json"), text.as_bytes())?;
    tracing::info!(folder = %args.out.display(), "wrote open_loop.png, open_loop.mp4 and separation.json");
    print(&text)
}

/// The middle of an episode of `length` steps, where traffic is under way.
fn window(length: usize) -> Option<Range<usize>> {
    let first = length.checked_sub(LENGTH)? / 2;
    Some(first..first + LENGTH)
}

/// 1 where a vehicle is, `[frames, 1, side, side]`; none where there is no vehicle in any frame, or no class of any pixel.
fn vehicles(classes: &[u8], side: i64) -> Option<Tensor> {
    classes.contains(&class::VEHICLE).then(|| {
        let classes = Tensor::from_slice(classes).view([-1, 1, side, side]);
        classes.eq(i64::from(class::VEHICLE)).to_kind(Kind::Float)
    })
}

fn separation(prediction: &OpenLoop, truth: &Tensor, vehicle: &Tensor) -> Separation {
    let error = |picture: &Tensor| {
        let squared = (picture - truth).square() * vehicle;
        squared.sum(Kind::Double).double_value(&[])
    };
    let composition = &prediction.composition;
    let other: Tensor = 1.0 - vehicle;
    let mean_over = |mask: &Tensor, area: &Tensor| {
        ((mask * area).sum(Kind::Double) / area.sum(Kind::Double)).double_value(&[])
    };
    let ratio = |mask: &Tensor| {
        let (inside, outside) = (mean_over(mask, vehicle), mean_over(mask, &other));
        MaskRatio {
            inside,
            outside,
            ratio: inside / outside,
        }
    };
    Separation {
        vehicle_share: vehicle.mean(Kind::Double).double_value(&[]),
        vehicle_error: error(&composition.image) / error(&composition.background),
        controllable: ratio(&prediction.composition.controllable.mask),
        noncontrollable: ratio(&prediction.composition.noncontrollable.mask),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vehicles_are_where_the_environment_says_and_nowhere_else() {
        assert!(vehicles(&[], 2).is_none(), "it tells nothing");
        assert!(vehicles(&[0, 1, 0, 1], 2).is_none(), "there is none");
        let vehicles = vehicles(&[0, class::VEHICLE, 0, 1], 2).unwrap();
        assert_eq!(vehicles.size(), [1, 1, 2, 2]);
        let values = Vec::<f32>::try_from(vehicles.flatten(0, -1)).unwrap();
        assert_eq!(values, [0.0, 1.0, 0.0, 0.0]);
    }
}
