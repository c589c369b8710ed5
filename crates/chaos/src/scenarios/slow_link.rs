//! Links that are slower than what is to be sent over them.

use std::time::Instant;

use anyhow::{Context as _, Result};

use super::{Context, RECOVERY, finish, partition, rollback};
use crate::interrupt;
use crate::table::Row;
use crate::watch::Inserts;

/// The hosts, and how many kbit/s their links carry meanwhile. All that is sampled, and the policies of all actors, go over
/// the learner's link, over that of a replay-server half of the batches and no policy.
const LINKS: [(&str, u32); 3] = [("replay-0", 256), ("learner", 256), ("learner", 1024)];

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let cluster = partition::start(context, folder.path())?;
    let secs = context.hold.as_secs();
    let mut rows = Vec::new();
    for (host, kbit_s) in LINKS {
        let how = format!(
            "tc tbf: {kbit_s} kbit/s both ways with a queue of 400 ms, for {secs} s and more"
        );
        let mut row = Row::new(&format!("slow link of {host}, {kbit_s} kbit/s"), &how);
        row.tried = 1;
        let network = cluster
            .network
            .as_ref()
            .context("the cluster has no network")?;
        let (before, begun) = (cluster.watch.updates(), Instant::now());
        network.slow(host, Some(kbit_s))?;
        // What was on its way and drawn ahead is used up by then.
        interrupt::sleep(context.hold / 2)?;
        let half = Instant::now();
        let moves = cluster.watch.recovery(half, Inserts::Any, RECOVERY);
        interrupt::sleep(context.hold.saturating_sub(begun.elapsed()))?;
        let during = cluster.watch.updates();
        network.slow(host, None)?;
        let at = Instant::now();
        row.notes.push(format!(
            "{} updates meanwhile",
            during.saturating_sub(before)
        ));
        if let Some(secs) = row.take(moves) {
            row.notes.push(format!(
                "updates and inserts were seen to move {secs:.1} s after half of that time"
            ));
        }
        row.recovered(cluster.watch.recovery(at, Inserts::Any, RECOVERY));
        rows.push(row);
    }
    let (begun, rollback) = (cluster.begun(), rollback(&cluster));
    finish(cluster, begun, rollback, &mut rows)?;
    Ok(rows)
}
