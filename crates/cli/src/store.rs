//! `isodream replay inspect` and `isodream replay verify`: a store's folder, also while a server has it.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::{Args, Subcommand};
use isodream_core::codec;
use isodream_replay::{Inspection, Quarantined, Verification, find_chunk, inspect, verify};
use isodream_telemetry::Rgb;

use crate::output::print_result;

/// What to do with the folder of a replay-server.
#[derive(Debug, Subcommand)]
pub(crate) enum StoreCommand {
    /// Sum up what a folder holds, and draw a frame of it
    Inspect(InspectArgs),
    /// Check every checksum of every byte; damage is listed, and ends with exit code 1
    Verify(VerifyArgs),
}

/// Options of `isodream replay inspect`.
#[derive(Debug, Args)]
pub(crate) struct InspectArgs {
    /// The folder
    dir: PathBuf,
    /// Draw one frame into this PNG
    #[arg(long)]
    frame: Option<PathBuf>,
    /// The frame's episode; the newest by default
    #[arg(long, requires = "frame")]
    episode: Option<u64>,
    /// The frame's step
    #[arg(long, default_value_t = 0, requires = "frame")]
    step: u32,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

/// Options of `isodream replay verify`.
#[derive(Debug, Args)]
pub(crate) struct VerifyArgs {
    /// The folder
    dir: PathBuf,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub(crate) fn run(command: &StoreCommand) -> anyhow::Result<()> {
    match command {
        StoreCommand::Inspect(args) => {
            let found = inspect(&args.dir)?;
            if let Some(path) = &args.frame {
                draw(args, &found, path)?;
            }
            print_result(&found, args.json, summary)
        }
        StoreCommand::Verify(args) => {
            let found = verify(&args.dir)?;
            print_result(&found, args.json, verification)?;
            ensure!(
                found.damage.is_empty(),
                "{} damaged stretches in {}; what they held is lost, a server skips them",
                found.damage.len(),
                args.dir.display()
            );
            Ok(())
        }
    }
}

fn draw(args: &InspectArgs, found: &Inspection, path: &Path) -> anyhow::Result<()> {
    let episode = args.episode.or(found.episodes.newest);
    let episode = episode.context("the store holds no episode to draw a frame of")?;
    let step = args.step;
    let chunk = find_chunk(&args.dir, episode, step)?
        .with_context(|| format!("episode {episode} has no step {step} in this store"))?;
    let steps = codec::decode(&chunk.payload)
        .with_context(|| format!("the chunk of step {step} of episode {episode} is damaged"))?;
    let side = (steps.image_bytes / 3).isqrt();
    ensure!(
        side * side * 3 == steps.image_bytes,
        "frames of {} bytes are no square pictures in colour",
        steps.image_bytes
    );
    let at = (step - chunk.first_step) as usize * steps.image_bytes;
    let pixels = steps.images[at..at + steps.image_bytes].to_vec();
    Rgb::new(side, side, pixels).save_png(path)?;
    tracing::info!(episode, step, path = %path.display(), "drew a frame");
    Ok(())
}

fn summary(found: &Inspection) -> String {
    let episodes = &found.episodes;
    let bytes: u64 = found.segments.iter().map(|segment| segment.bytes).sum();
    let records: u64 = found.segments.iter().map(|segment| segment.records).sum();
    let mut lines = vec![
        format!("format     {}", found.format),
        format!(
            "belongs to {}",
            found
                .identity
                .as_ref()
                .map_or("nobody yet", |identity| identity.env_spec.as_str())
        ),
        format!(
            "segments   {}: {:.1} MB, {records} records",
            found.segments.len(),
            bytes as f64 / 1e6
        ),
        format!(
            "episodes   {} of {} to {} steps, {} complete; {} steps",
            episodes.count, episodes.shortest, episodes.longest, episodes.complete, episodes.steps
        ),
        format!(
            "inserted   {} steps since the store was made",
            found.inserted_steps
        ),
    ];
    lines.extend(found.actors.iter().map(|actor| {
        format!(
            "actor      {} epoch {}, next chunk {}",
            actor.actor_id, actor.epoch, actor.next_seq
        )
    }));
    lines.extend(damage(&found.damage, found.unfinished_bytes));
    lines.join("\n")
}

fn verification(found: &Verification) -> String {
    let mut lines = vec![format!(
        "{} records in {} segments ({:.1} MB): {}",
        found.records,
        found.segments,
        found.bytes as f64 / 1e6,
        if found.damage.is_empty() {
            "sound"
        } else {
            "damaged"
        }
    )];
    lines.extend(damage(&found.damage, found.unfinished_bytes));
    lines.join("\n")
}

fn damage(stretches: &[Quarantined], unfinished_bytes: u64) -> Vec<String> {
    let mut lines: Vec<String> = stretches
        .iter()
        .map(|stretch| {
            format!(
                "damaged    {} from byte {}, {} bytes: {}",
                stretch.segment.display(),
                stretch.offset,
                stretch.bytes,
                stretch.reason
            )
        })
        .collect();
    if unfinished_bytes > 0 {
        lines.push(format!(
            "unfinished {unfinished_bytes} bytes at the end of the newest segment; nothing of them was acknowledged"
        ));
    }
    lines
}
