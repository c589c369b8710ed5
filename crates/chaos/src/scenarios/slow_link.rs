//! Links that are slower than what is to be sent over them.

use std::time::Instant;

use anyhow::{Context as _, Result};

use super::{Context, RECOVERY, finish, partition, rollback};
use crate::interrupt;
use crate::table::Row;
use crate::watch::Inserts;

/// A tenth of what the learner draws at full pace.
const KBIT_S: u32 = 256;

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let cluster = partition::start(context, folder.path())?;
    let secs = context.hold.as_secs();
    let mut rows = Vec::new();
    for host in ["replay-0", "learner"] {
        let how = format!("tc tbf: {KBIT_S} kbit/s both ways with a queue of 400 ms, for {secs} s");
        let mut row = Row::new(&format!("slow link of {host}"), &how);
        row.tried = 1;
        let network = cluster
            .network
            .as_ref()
            .context("the cluster has no network")?;
        let (before, begun) = (cluster.watch.updates(), Instant::now());
        network.slow(host, Some(KBIT_S))?;
        let moves = cluster.watch.recovery(begun, Inserts::Any, RECOVERY);
        let slept = interrupt::sleep(context.hold.saturating_sub(begun.elapsed()));
        let during = cluster.watch.updates();
        network.slow(host, None)?;
        slept?;
        let at = Instant::now();
        row.notes.push(format!(
            "{} updates meanwhile",
            during.saturating_sub(before)
        ));
        if let Some(secs) = row.take(moves) {
            row.notes.push(format!(
                "updates and inserts were seen to move {secs:.1} s after it began"
            ));
        }
        row.recovered(cluster.watch.recovery(at, Inserts::Any, RECOVERY));
        rows.push(row);
    }
    let (begun, rollback) = (cluster.begun(), rollback(&cluster));
    finish(cluster, begun, rollback, &mut rows)?;
    Ok(rows)
}
