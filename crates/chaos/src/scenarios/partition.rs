//! Hosts on a network of their own, with cut connections and pulled cables.

use std::path::Path;
use std::time::Instant;

use anyhow::{Context as _, Result};

use super::{Context, RECOVERY, finish, rollback};
use crate::cluster::Cluster;
use crate::interrupt;
use crate::netns::Network;
use crate::plan::Plan;
use crate::secrets;
use crate::table::Row;
use crate::watch::Inserts;

/// Each on a host of its own: two replay-servers, a learner, eight actors, three of them with ledgers, and an evaluator.
const HOSTS: [&str; 12] = [
    "replay-0",
    "replay-1",
    "learner",
    "actor-0",
    "actor-1",
    "actor-2",
    "actor-3",
    "actor-4",
    "ledger-0",
    "ledger-1",
    "ledger-2",
    "evaluator",
];

/// A training over [`HOSTS`] with mutual TLS and tokens, whose files go into `folder`.
pub(super) fn start(context: &Context, folder: &Path) -> Result<Cluster> {
    let network = Network::new(HOSTS)?;
    let addresses = HOSTS.iter().map(|host| network.address(host));
    let secrets = folder.join("secrets");
    secrets::make(
        &context.binary,
        &secrets,
        &addresses.collect::<Result<Vec<_>>>()?,
        None,
    )?;
    let plan = Plan {
        actors: 5,
        ledgers: 3,
        network: Some(network),
        secrets: Some(secrets),
        ..Plan::usual(&[])
    };
    Cluster::start(&context.binary, plan)
}

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let cluster = start(context, folder.path())?;
    let secs = context.hold.as_secs();
    let actor = actor_of(&cluster, 0)?;
    let cut = format!("everything between the two hosts is dropped for {secs} s");
    let pulled = format!("the host's link is down for {secs} s");
    let mut rows = Vec::new();
    for (fault, how, one, other) in [
        (
            "partition of an actor and its replay-server",
            &cut,
            actor.as_str(),
            Some("replay-0"),
        ),
        (
            "partition of the learner and a replay-server",
            &cut,
            "learner",
            Some("replay-0"),
        ),
        ("a replay-server without network", &pulled, "replay-1", None),
        ("the learner without network", &pulled, "learner", None),
    ] {
        let mut row = Row::new(fault, how);
        row.tried = 1;
        let recovered = isolate(context, &cluster, one, other, &mut row);
        row.recovered(recovered);
        rows.push(row);
    }
    let (begun, rollback) = (cluster.begun(), rollback(&cluster));
    finish(cluster, begun, rollback, &mut rows)?;
    Ok(rows)
}

/// An actor that sends to this replay-server.
fn actor_of(cluster: &Cluster, index: usize) -> Result<String> {
    let log = cluster.role(&format!("replay-{index}"))?.log_since(0)?;
    let found = log.lines().rev().find_map(|line| {
        let actor = line
            .split_once("actor connected actor=")?
            .1
            .split(' ')
            .next()?;
        actor.starts_with("actor-").then(|| actor.to_owned())
    });
    found.with_context(|| format!("no actor sends to replay-{index}"))
}

/// Keeps `one` from `other`, or from everybody, for a while. Returns the seconds from the end of that until it is
/// connected again and the training moves.
fn isolate(
    context: &Context,
    cluster: &Cluster,
    one: &str,
    other: Option<&str>,
    row: &mut Row,
) -> Result<f64> {
    let network = cluster
        .network
        .as_ref()
        .context("the cluster has no network")?;
    // Whoever talks to a server notices.
    let witness = if one.starts_with("replay") {
        "learner"
    } else {
        one
    };
    let mark = cluster.mark();
    let separate = |is_cut: bool| match other {
        Some(other) => network.cut(one, other, is_cut),
        None => network.link(one, !is_cut),
    };
    let before = cluster.watch.updates();
    separate(true)?;
    let slept = interrupt::sleep(context.hold);
    let during = cluster.watch.updates();
    separate(false)?;
    slept?;
    let at = Instant::now();
    row.notes.push(format!(
        "{} updates meanwhile",
        during.saturating_sub(before)
    ));
    row.notes
        .push(cluster.line(&mark, witness, "connection lost, trying again", RECOVERY)?);
    cluster.line(&mark, witness, ": connected peer=replay-server", RECOVERY)?;
    cluster.watch.recovery(at, Inserts::Any, RECOVERY)
}
