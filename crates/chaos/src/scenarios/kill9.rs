//! `kill -9` in random order under load.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use rand::seq::{IndexedRandom, SliceRandom};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::checkpoint::numbered;
use super::{Context, RECOVERY, finish, inserts_into, rollback};
use crate::cluster::Cluster;
use crate::interrupt;
use crate::plan::Plan;
use crate::table::Row;
use crate::watch::Inserts;

/// Failures after which going on shows nothing new.
const ENOUGH: usize = 5;

/// How long a checkpoint may be waited for.
const NEXT_CHECKPOINT: Duration = Duration::from_secs(60);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Victim {
    Actor,
    Learner,
    LearnerInCheckpoint,
    Replay,
}

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let plan = Plan::usual(&["learner.checkpoint_interval=10"]);
    let (replays, actors, ledgers) = (plan.replays, plan.actors, plan.ledgers);
    let cluster = Cluster::start(&context.binary, plan)?;
    interrupt::until(
        "there is a checkpoint to go on from",
        NEXT_CHECKPOINT,
        || Ok(numbered(&cluster.checkpoints())?.pop()),
    )?;
    let mut random = ChaCha8Rng::seed_from_u64(context.seed);
    let mut order = Vec::new();
    for kill in 0..context.kills {
        order.extend([Victim::Actor, Victim::Replay]);
        order.push(if kill % 2 == 0 {
            Victim::LearnerInCheckpoint
        } else {
            Victim::Learner
        });
    }
    order.shuffle(&mut random);
    let mut rows = [
        Row::new(
            "kill -9 of an actor",
            "SIGKILL, under load, in random order with those below",
        ),
        Row::new("kill -9 of the learner", "the same"),
        Row::new(
            "kill -9 of the learner in mid-checkpoint",
            "the same, while its temporary folder is there",
        ),
        Row::new("kill -9 of a replay-server", "the same"),
    ];
    let actors: Vec<String> = (0..actors)
        .map(|n| format!("actor-{n}"))
        .chain((0..ledgers).map(|n| format!("ledger-{n}")))
        .collect();
    let (mut partial, mut moved_on, count) = (0, 0, order.len());
    for (number, victim) in order.into_iter().enumerate() {
        let row = &mut rows[victim as usize];
        row.tried += 1;
        let recovered = match victim {
            Victim::Actor => {
                let name = actors.choose(&mut random).map_or("actor-0", String::as_str);
                kill_actor(&cluster, name)
            }
            Victim::Learner => kill_learner(&cluster).map(|(secs, _)| secs),
            Victim::LearnerInCheckpoint => wait_for_partial(&cluster.checkpoints())
                .and_then(|()| kill_learner(&cluster))
                .map(|(secs, in_checkpoint)| {
                    partial += u32::from(in_checkpoint);
                    secs
                }),
            Victim::Replay => kill_replay(&cluster, random.random_range(0..replays)).map(|back| {
                moved_on += u32::from(back.moved_on);
                back.seconds
            }),
        };
        let words = match &recovered {
            Ok(secs) => format!("recovered in {secs:.1} s"),
            Err(error) => format!("{error:#}"),
        };
        eprintln!("chaos: kill {} of {count}: {victim:?}, {words}", number + 1);
        row.recovered(recovered);
        if rows.iter().map(|row| row.failures.len()).sum::<usize>() >= ENOUGH {
            break;
        }
        interrupt::sleep(Duration::from_millis(random.random_range(0..1000)))?;
    }
    rows[2]
        .notes
        .push(format!("{partial} of them left a temporary folder behind"));
    rows[3].notes.push(format!(
        "{moved_on} times its actors had turned to the next server first"
    ));
    let (begun, rollback) = (cluster.begun(), rollback(&cluster));
    finish(cluster, begun, rollback, &mut rows)?;
    Ok(rows.into())
}

/// Kills an actor; it is back when a replay-server greets its next process.
pub(super) fn kill_actor(cluster: &Cluster, name: &str) -> Result<f64> {
    let lane = if name.starts_with("ledger") { "-0" } else { "" };
    let words = format!("actor connected actor={name}{lane} ");
    let mark = cluster.mark();
    let at = Instant::now();
    cluster.role(name)?.kill()?;
    cluster.line(&mark, "replay", &words, RECOVERY)?;
    let back = at.elapsed().as_secs_f64();
    Ok(back.max(cluster.watch.recovery(at, Inserts::Any, RECOVERY)?))
}

/// Seconds until it trains again, and whether it left an unfinished checkpoint behind.
pub(super) fn kill_learner(cluster: &Cluster) -> Result<(f64, bool)> {
    let mark = cluster.mark();
    let at = Instant::now();
    cluster.role("learner")?.kill()?;
    let in_checkpoint = has_partial(&cluster.checkpoints());
    let updates = cluster.watch.updates();
    let seconds = cluster.watch.recovery(at, Inserts::Any, RECOVERY)?;
    let resumed = cluster.line(&mark, "learner", "resumed from checkpoint", RECOVERY)?;
    eprintln!("chaos: killed at {updates} updates or later; {resumed}");
    Ok((seconds, in_checkpoint))
}

/// How a killed replay-server was got over.
#[derive(Debug, Clone, Copy)]
pub(super) struct ReplayBack {
    pub(super) seconds: f64,
    /// It was away for longer than an actor waits, and inserts go on at another server.
    pub(super) moved_on: bool,
}

/// Kills a replay-server. It is got over when updates move, and inserts into its store; or, where an actor says that it
/// has turned to the next server, inserts into any store after that.
pub(super) fn kill_replay(cluster: &Cluster, index: usize) -> Result<ReplayBack> {
    let (name, address) = (format!("replay-{index}"), &cluster.layout.replays[index]);
    let mark = cluster.mark();
    let inserts = inserts_into(cluster, index);
    let at = Instant::now();
    cluster.role(&name)?.kill()?;
    let turned = format!("a replay-server stays away, turning to the next address=\"{address}\"");
    let mut turned_at = None;
    let what = "updates and inserts move again";
    let (moves_at, moved_on) = interrupt::until(what, RECOVERY, || {
        if let Some(moves_at) = cluster.watch.moves(at, inserts) {
            return Ok(Some((moves_at, false)));
        }
        if turned_at.is_none() && cluster.said(&mark, "", &turned)?.is_some() {
            turned_at = Some(Instant::now());
        }
        let moves_at = turned_at.and_then(|turned_at| cluster.watch.moves(turned_at, Inserts::Any));
        Ok(moves_at.map(|moves_at| (moves_at, true)))
    })
    .with_context(|| cluster.watch.last_words())?;
    cluster.line(&mark, &name, "serving replay", RECOVERY)?;
    let lost = format!("connection lost, trying again peer=replay-server {address}");
    cluster.line(&mark, "learner", &lost, RECOVERY)?;
    Ok(ReplayBack {
        seconds: moves_at.duration_since(at).as_secs_f64(),
        moved_on,
    })
}

/// Waits until the learner begins to write a checkpoint.
fn wait_for_partial(checkpoints: &Path) -> Result<()> {
    let begun = Instant::now();
    while begun.elapsed() < NEXT_CHECKPOINT {
        if has_partial(checkpoints) {
            return Ok(());
        }
        std::thread::sleep(Duration::from_micros(200));
    }
    bail!("the learner began no checkpoint within {NEXT_CHECKPOINT:?}");
}

fn has_partial(checkpoints: &Path) -> bool {
    let Ok(entries) = std::fs::read_dir(checkpoints) else {
        return false;
    };
    entries
        .flatten()
        .any(|entry| entry.file_name().to_string_lossy().ends_with(".partial"))
}
