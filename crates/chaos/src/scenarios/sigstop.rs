//! Processes that hang: SIGSTOP, and SIGCONT after a while.

use std::time::Instant;

use anyhow::Result;
use rustix::process::Signal;

use super::{Context, RECOVERY, drawn_ahead, finish};
use crate::cluster::Cluster;
use crate::interrupt;
use crate::plan::Plan;
use crate::table::Row;
use crate::watch::Inserts;

/// Who hangs, and who has to say what of it.
const HANGS: [(&str, &str, &str); 5] = [
    ("actor-0", "replay", "actor connected actor=actor-0 "),
    ("ledger-0", "replay", "actor connected actor=ledger-0-0 "),
    ("evaluator", "learner", "actor=\"evaluator\""),
    ("learner", "actor", "the learner is behind"),
    ("replay-0", "learner", "connection lost, trying again"),
];

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let cluster = Cluster::start(&context.binary, Plan::usual(&[]))?;
    let mut rows = Vec::new();
    for (name, witness, words) in HANGS {
        let how = format!("SIGSTOP, and SIGCONT after {} s", context.hold.as_secs());
        let mut row = Row::new(&format!("{name} hangs"), &how);
        row.tried = 1;
        let mark = cluster.mark();
        let recovered = hang(context, &cluster, name, &mut row);
        row.recovered(recovered);
        if let Some(line) = row.take(cluster.line(&mark, witness, words, RECOVERY)) {
            row.notes.push(line);
        }
        rows.push(row);
    }
    // Nobody was killed, but the connection to a replay-server that hangs is lost, and what was on it.
    let (begun, ahead) = (cluster.begun(), drawn_ahead(&cluster));
    finish(cluster, begun, ahead, &mut rows)?;
    Ok(rows)
}

fn hang(context: &Context, cluster: &Cluster, name: &str, row: &mut Row) -> Result<f64> {
    let role = cluster.role(name)?;
    let (before, exits) = (cluster.watch.updates(), role.exits().len());
    role.signal(Signal::STOP)?;
    let slept = interrupt::sleep(context.hold);
    let during = cluster.watch.updates();
    role.signal(Signal::CONT)?;
    slept?;
    let at = Instant::now();
    row.notes.push(format!(
        "{} updates meanwhile",
        during.saturating_sub(before)
    ));
    let seconds = cluster.watch.recovery(at, Inserts::Any, RECOVERY)?;
    let ended = role.exits().len() - exits;
    if ended > 0 {
        row.failures.push(format!("{name} ended {ended} times"));
    }
    Ok(seconds)
}
