//! Clocks that are wrong. `libfaketime` shifts a role's wall clock, also while it runs; its monotonic clock stays.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Result;

use super::{Context, finish, kill9, rollback};
use crate::cluster::Cluster;
use crate::faketime;
use crate::interrupt;
use crate::plan::Plan;
use crate::table::Row;

/// How long a role runs with a clock that was just shifted.
const SHIFTED: Duration = Duration::from_secs(5);

const ROLES: [&str; 4] = ["replay-0", "learner", "actor-0", "ledger-0"];

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let library = faketime::library()?;
    let folder = tempfile::tempdir()?;
    let shift = |name: &str| folder.path().join(name);
    let mut plan = Plan::usual(&[]);
    for name in ROLES {
        set(&shift(name), "+0")?;
        let variables = [
            ("LD_PRELOAD", library.to_owned()),
            ("FAKETIME_TIMESTAMP_FILE", shift(name).display().to_string()),
            ("FAKETIME_CACHE_DURATION", "1".to_owned()),
            ("FAKETIME_DONT_FAKE_MONOTONIC", "1".to_owned()),
        ];
        let variables = variables.map(|(key, value)| (key.to_owned(), value));
        plan.env.insert(name.into(), variables.into());
    }
    let cluster = Cluster::start(&context.binary, plan)?;
    let mut rows = Vec::new();
    for name in ROLES {
        for (fault, to) in [("one hour ahead", "+3600"), ("back by one hour", "+0")] {
            let mut row = Row::new(
                &format!("{name}: clock {fault}"),
                "libfaketime, while it runs, and then kill -9",
            );
            row.tried = 1;
            let recovered = jump(&cluster, name, &shift(name), to);
            row.recovered(recovered);
            rows.push(row);
        }
    }
    let (begun, rollback) = (cluster.begun(), rollback(&cluster));
    finish(cluster, begun, rollback, &mut rows)?;
    Ok(rows)
}

/// Shifts a role's clock, lets it run, and kills it, so that its next process begins with the new clock.
fn jump(cluster: &Cluster, name: &str, file: &Path, to: &str) -> Result<f64> {
    set(file, to)?;
    interrupt::sleep(SHIFTED)?;
    match name {
        "learner" => kill9::kill_learner(cluster).map(|(secs, _)| secs),
        "replay-0" => kill9::kill_replay(cluster, 0).map(|back| back.seconds),
        _ => kill9::kill_actor(cluster, name),
    }
}

/// In one step, so that nobody reads half of it.
fn set(file: &Path, shift: &str) -> Result<()> {
    let next: PathBuf = file.with_extension("next");
    fs::write(&next, shift)?;
    Ok(fs::rename(&next, file)?)
}
