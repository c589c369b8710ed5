//! `isodream env list`.

use clap::Args;
use isodream_core::EnvSpec;
use isodream_envs::{ids, spec};

use super::env_config;
use crate::output::print_result;

/// Options of `isodream env list`.
#[derive(Debug, Args)]
pub(crate) struct ListArgs {
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
    print_result(&specs, args.json, |specs| table(specs))
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
