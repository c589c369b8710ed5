//! The faults, a module each.

mod calls;
mod checkpoint;
mod clock;
mod disk_full;
mod kill9;
mod nan_env;
mod nan_loss;
mod partition;
mod security;
mod sigstop;
mod slow_link;
mod soak;
mod versions;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Result, bail};

use crate::cluster::Cluster;
use crate::table::Row;
use crate::watch::Inserts;

/// What all scenarios are given.
#[derive(Debug)]
pub(crate) struct Context {
    /// The `isodream` binary.
    pub(crate) binary: PathBuf,
    /// Kills of each kind of role.
    pub(crate) kills: usize,
    /// Length of the soak.
    pub(crate) soak: Duration,
    /// How long a fault lasts that lasts.
    pub(crate) hold: Duration,
    pub(crate) seed: u64,
}

/// A kind of fault.
#[derive(Debug)]
pub(crate) struct Scenario {
    pub(crate) name: &'static str,
    pub(crate) about: &'static str,
    pub(crate) run: fn(&Context) -> Result<Vec<Row>>,
}

/// All of them, in the order in which they run.
pub(crate) const ALL: &[Scenario] = &[
    Scenario {
        name: "kill9",
        about: "kill -9 of actors, learner (also in mid-checkpoint) and replay-servers in random order",
        run: kill9::run,
    },
    Scenario {
        name: "partition",
        about: "12 hosts as network namespaces; partitions and pulled cables",
        run: partition::run,
    },
    Scenario {
        name: "slow-link",
        about: "the same hosts; a replay-server and the learner behind a slow link",
        run: slow_link::run,
    },
    Scenario {
        name: "sigstop",
        about: "SIGSTOP of each role for a while",
        run: sigstop::run,
    },
    Scenario {
        name: "disk-full",
        about: "a replay-server whose disk, a small tmpfs, is full for a while",
        run: disk_full::run,
    },
    Scenario {
        name: "clock",
        about: "a role whose clock is one hour off, and then jumps back",
        run: clock::run,
    },
    Scenario {
        name: "versions",
        about: "old clients at new servers and new clients at old servers",
        run: versions::run,
    },
    Scenario {
        name: "security",
        about: "wrong tokens, roles, encryption and certificates at every call",
        run: security::run,
    },
    Scenario {
        name: "checkpoint",
        about: "the newest checkpoint damaged, cut, or without its manifest",
        run: checkpoint::run,
    },
    Scenario {
        name: "nan-env",
        about: "NaN rewards from an environment",
        run: nan_env::run,
    },
    Scenario {
        name: "nan-loss",
        about: "NaN in a loss",
        run: nan_loss::run,
    },
    Scenario {
        name: "soak",
        about: "quiet training; memory and file descriptors of each role",
        run: soak::run,
    },
];

/// How long a run may take to recover before that counts as a failure.
pub(crate) const RECOVERY: Duration = Duration::from_secs(90);

/// The scenarios of these names, or all.
pub(crate) fn choose(names: &[String]) -> Result<Vec<&'static Scenario>> {
    for name in names {
        if !ALL.iter().any(|scenario| scenario.name == name) {
            let known: Vec<_> = ALL.iter().map(|scenario| scenario.name).collect();
            bail!("there is no scenario {name}, only {}", known.join(", "));
        }
    }
    let wanted = |name| names.is_empty() || names.iter().any(|wanted| wanted == name);
    Ok(ALL
        .iter()
        .filter(|scenario| wanted(scenario.name))
        .collect())
}

/// Steps that a learner which was killed may have to draw again: those since its last whole checkpoint, which is one
/// before the last while that is being written, and those that it had drawn ahead.
fn rollback(cluster: &Cluster) -> u64 {
    let interval = cluster.config.learner.checkpoint_interval;
    2 * interval * cluster.config.batch_steps() + drawn_ahead(cluster)
}

/// Steps that may be on their way to the learner, which draws them again where a connection is lost.
fn drawn_ahead(cluster: &Cluster) -> u64 {
    let ahead = 2 * cluster.config.learner.prefetch_batches as u64 + 2;
    ahead * cluster.config.batch_steps()
}

/// Inserts into the store of this server, where there were some lately.
fn inserts_into(cluster: &Cluster, index: usize) -> Inserts {
    if cluster.watch.inserts_move(index, Duration::from_secs(20)) {
        Inserts::Into(index)
    } else {
        Inserts::Any
    }
}

/// Checks that the ratio was kept since `since`, and stops the cluster: the last that happens to every training.
fn finish(cluster: Cluster, since: Instant, rollback: u64, rows: &mut [Row]) -> Result<()> {
    let excess = cluster.watch.excess(since, rollback);
    let mut failures = Vec::new();
    if excess.inserted.steps > 0.0 || excess.sampled.steps > 0.0 {
        failures.push(format!(
            "the replay ratio was left, in sampled steps beyond the limiter's bounds: inserts ahead {}, draws ahead {}",
            excess.inserted, excess.sampled
        ));
    }
    let audit = cluster.finish(&mut failures, |_| Ok(()))?;
    for row in &mut *rows {
        row.audit = Some(audit);
    }
    if let Some(row) = rows.first_mut() {
        row.notes.push(format!(
            "sampled steps within the limiter's bounds, at the least: {:.0} where inserts were ahead, {:.0} where draws were",
            0.0 - excess.inserted.steps,
            0.0 - excess.sampled.steps
        ));
        row.notes.push(format!(
            "{} steps stored by all actors; chunks missing between others: {}",
            audit.stored_steps, audit.missing_chunks
        ));
        row.failures.extend(failures);
    }
    Ok(())
}
