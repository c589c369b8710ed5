//! A loss that is not a number any more.

use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};

use super::checkpoint::numbered;
use super::{Context, RECOVERY, finish};
use crate::cluster::Cluster;
use crate::interrupt;
use crate::plan::Plan;
use crate::table::Row;
use crate::watch::Inserts;

/// No weight survives a step of this length.
const ABSURD: &str = "optimizer.model_lr=1e30";

/// How long the learner may take to its end.
const END: Duration = Duration::from_secs(60);

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let cluster = Cluster::start(&context.binary, Plan::usual(&[]))?;
    let how = format!("a learner that goes on with {ABSURD}; then with what it had before");
    let mut rows = [Row::new("NaN in a loss", &how)];
    for _ in 0..context.kills.clamp(1, 3) {
        rows[0].tried += 1;
        let recovered = diverge(&cluster, &mut rows[0]);
        rows[0].recovered(recovered);
    }
    let (begun, rollback) = (cluster.begun(), super::rollback(&cluster));
    finish(cluster, begun, rollback, &mut rows)?;
    Ok(rows.into())
}

fn diverge(cluster: &Cluster, row: &mut Row) -> Result<f64> {
    let learner = cluster.role("learner")?;
    interrupt::until("there is a checkpoint", RECOVERY, || {
        Ok(numbered(&cluster.checkpoints())?.pop())
    })?;
    learner.hold();
    learner.kill()?;
    let (start, exits) = (learner.log_end(), learner.exits().len());
    let kept = numbered(&cluster.checkpoints())?.pop();
    learner.release(|spec| spec.command.extend(["--set".into(), ABSURD.into()]));
    let status = interrupt::until("the learner ends", END, || {
        Ok(learner.exits().get(exits).copied())
    })?;
    learner.hold();
    // The supervisor may have begun another one in between.
    if learner.pid().is_some() {
        learner.kill()?;
    }
    ensure!(
        status.code() == Some(1),
        "it ended with {status} instead of 1"
    );
    let log = learner.log_since(start)?;
    let line = log
        .lines()
        .find(|line| line.contains("not finite") || line.contains("NaN"))
        .with_context(|| format!("no line tells of a NaN: {log}"))?;
    if row.notes.is_empty() {
        row.notes.push(format!("the learner says: {line}"));
    }
    let left = numbered(&cluster.checkpoints())?.pop();
    ensure!(
        left == kept,
        "the newest checkpoint was {kept:?}, now it is {left:?}"
    );
    let mark = cluster.mark();
    learner.release(|spec| spec.command.truncate(spec.command.len() - 2));
    let at = Instant::now();
    let seconds = cluster.watch.recovery(at, Inserts::Any, RECOVERY)?;
    cluster.line(&mark, "learner", "resumed from checkpoint", RECOVERY)?;
    Ok(seconds)
}
