//! `isodream env list`.

use std::path::PathBuf;

use clap::Args;
use isodream_core::EnvSpec;
use isodream_envs::{Driver, RandomDriver, ids, make, spec};
use isodream_telemetry::Rgb;

use super::env_config;
use crate::output::print_result;

const SEED: u64 = 1;
/// Agent steps before the picture.
const STEPS: usize = 8;
const COLUMNS: usize = 6;

/// Options of `isodream env list`.
#[derive(Debug, Args)]
pub(crate) struct ListArgs {
    /// Draw a picture of each as well, into this PNG file
    #[arg(long)]
    sheet: Option<PathBuf>,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub(super) fn run(args: &ListArgs) -> anyhow::Result<()> {
    let mut specs = Vec::new();
    for id in ids() {
        specs.push(spec(&env_config(id, &[])?)?);
    }
    if let Some(path) = &args.sheet {
        sheet()?.save_png(path)?;
    }
    print_result(&specs, args.json, |specs| table(specs))
}

/// The same seed in every environment, after some random steps.
fn sheet() -> anyhow::Result<Rgb> {
    let mut tiles = Vec::new();
    for id in ids() {
        let mut env = make(&env_config(id, &[])?)?;
        let mut driver = RandomDriver::new(SEED);
        let mut shown = env.reset(SEED)?;
        for _ in 0..STEPS {
            let action = driver.act(env.as_ref())?;
            shown = env.step(&action)?;
        }
        let shape = env.spec().image;
        let picture = Rgb::new(shape.width, shape.height, shown.image).upscale(2);
        tiles.push(picture.labelled(id));
    }
    let rows: Vec<Vec<Rgb>> = tiles.chunks(COLUMNS).map(<[Rgb]>::to_vec).collect();
    Ok(Rgb::tile(&rows, 4))
}

fn table(specs: &[EnvSpec]) -> String {
    let width = specs.iter().map(|spec| spec.id.len()).max().unwrap_or(0);
    let mut lines = vec![format!(
        "{:<width$} {:>7} {:>7} {:>6}",
        "id", "actions", "repeat", "steps"
    )];
    lines.extend(specs.iter().map(|spec| {
        format!(
            "{:<width$} {:>7} {:>7} {:>6}",
            spec.id, spec.action_dim, spec.action_repeat, spec.time_limit
        )
    }));
    lines.join("\n")
}
