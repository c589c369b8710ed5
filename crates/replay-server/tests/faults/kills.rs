//! kill -9, crashes inside append, roll and open, a failed sync and a full disk, while actors insert.

use std::collections::BTreeSet;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use isodream_core::Chunk;
use isodream_replay::{Selector, Store, StoreOptions, Table, inspect};
use isodream_rpc::AppendClient;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::runtime::Runtime;

use crate::process::{
    DEADLINE, DISK_FAILED, STEPS, ServerProcess, actor, chunk, free_address, inserted_steps,
};

const ACTORS: u64 = 8;
const KILLS: u32 = 100;
const SIGABRT: i32 = 6;
/// Where a process dies that is not killed from outside.
const CRASHES: [&str; 6] = [
    "append-before-write=10%return(abort)",
    "append-before-sync=10%return(abort)",
    "append-sync=10%return(abort)",
    "roll-created=return(abort)",
    "roll-before-folder-sync=return(abort)",
    "open-segment=return(abort)",
];

#[test]
fn a_hundred_kills_lose_nothing_that_was_acknowledged() {
    let seed = rand::rng().next_u64();
    eprintln!("seed {seed}");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut restart_secs = Vec::new();
    let mut crashes = 0;
    insert_while(u64::MAX, |world| {
        for death in 0..KILLS {
            let failpoints = match death % 4 {
                0 => CRASHES[rng.random_range(0..CRASHES.len())],
                _ => "",
            };
            let mut server = world.start(failpoints);
            let since = Instant::now();
            if failpoints.is_empty() {
                world.check_acknowledged();
                restart_secs.push(since.elapsed().as_secs_f64());
            }
            let life = Duration::from_millis(rng.random_range(20..300));
            let since = Instant::now();
            while since.elapsed() < life && server.ended().is_none() {
                std::thread::sleep(Duration::from_millis(1));
            }
            let own_end = server.ended();
            crashes += u32::from(own_end.is_some_and(|status| status.signal() == Some(SIGABRT)));
            server.kill();
        }
    });
    assert!(crashes > 0, "no crash point was reached");
    restart_secs.sort_by(f64::total_cmp);
    eprintln!(
        "{KILLS} deaths, {crashes} of them at crash points; from exec to the first answer {:.3} s in the median, {:.3} s at most",
        restart_secs[restart_secs.len() / 2],
        restart_secs[restart_secs.len() - 1]
    );
}

#[test]
fn a_failed_sync_ends_the_process_with_its_code_and_loses_nothing() {
    for failpoints in [
        "append-sync=50*off->return",
        "roll-before-folder-sync=1*off->return",
    ] {
        insert_while(u64::MAX, |world| {
            let mut server = world.start(failpoints);
            assert_eq!(server.wait().code(), Some(DISK_FAILED));
            let _server = world.start("");
            assert!(world.check_acknowledged() > 0);
        });
    }
}

#[test]
fn a_full_disk_holds_inserts_until_there_is_room() {
    // Each try finds it full, and comes half a second later.
    for failpoints in [
        "append-before-write=50*off->4*return(full)->off",
        "roll-created=1*off->4*return(full)->off",
    ] {
        insert_while(u64::MAX, |world| {
            let mut server = world.start(failpoints);
            let full = |actor: &AppendClient| {
                let why = actor.waiting().unwrap_or_default();
                why.contains("no space")
            };
            world.until("the disk is full", || world.actors.iter().any(full));
            let held = world.check_acknowledged();
            world.until("there is room", || !world.actors.iter().any(full));
            world.until("inserts go on", || world.check_acknowledged() > held);
            assert!(server.ended().is_none(), "one server, all the time");
        });
    }
}

#[test]
fn a_crash_inside_eviction_loses_no_count_and_no_position() {
    insert_while(1000, |world| {
        for failpoints in [
            "evict-before-delete=return(abort)",
            "evict-after-delete=return(abort)",
        ] {
            let mut server = world.start(failpoints);
            assert_eq!(server.wait().signal(), Some(SIGABRT));
            let _server = world.start("");
            assert!(world.check_acknowledged() > 0);
        }
    });
}

struct World<'a> {
    capacity_steps: u64,
    folder: &'a Path,
    address: &'a str,
    runtime: &'a Runtime,
    actors: &'a [AppendClient],
}

impl World<'_> {
    fn start(&self, failpoints: &str) -> ServerProcess {
        ServerProcess::start(self.folder, self.address, self.capacity_steps, failpoints)
    }

    /// Waits until `condition` holds.
    fn until(&self, what: &str, condition: impl Fn() -> bool) {
        let since = Instant::now();
        while !condition() {
            assert!(since.elapsed() < DEADLINE, "waited too long: {what}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Everything that was acknowledged before is known to the server that starts now. How many chunks.
    fn check_acknowledged(&self) -> u64 {
        let acknowledged = self
            .actors
            .iter()
            .map(AppendClient::acknowledged_chunks)
            .sum::<u64>();
        let inserted = self.runtime.block_on(inserted_steps(self.address));
        assert!(
            inserted >= acknowledged * u64::from(STEPS),
            "{acknowledged} chunks acknowledged, {inserted} steps found"
        );
        acknowledged
    }
}

/// Inserts with all actors while `harm` is done, then lets them finish and checks that every chunk was stored
/// once, and is there where none are evicted.
fn insert_while(capacity_steps: u64, harm: impl FnOnce(&World<'_>)) {
    let folder = tempfile::tempdir().unwrap();
    let address = free_address();
    let runtime = Runtime::new().unwrap();
    let actors = start_actors(&runtime, &address);
    let world = World {
        capacity_steps,
        folder: folder.path(),
        address: &address,
        runtime: &runtime,
        actors: &actors,
    };
    let enough = &AtomicBool::new(false);
    let chunks = std::thread::scope(|scope| {
        let _end = StopSending {
            enough,
            actors: &actors,
        };
        let senders: Vec<_> = (0..)
            .zip(&actors)
            .map(|(number, actor)| scope.spawn(move || send_until(actor, number, enough)))
            .collect();
        harm(&world);
        enough.store(true, Ordering::Relaxed);
        let _server = world.start("");
        let sent: Vec<_> = senders
            .into_iter()
            .map(|sender| sender.join().unwrap())
            .collect();
        // All episodes are made equally long, so that one sequence length covers each.
        let most = sent.iter().copied().max().unwrap();
        for ((number, actor), sent) in (0..).zip(&actors).zip(sent) {
            for seq in sent..most {
                actor.send_blocking(chunk(number, seq)).unwrap();
            }
            runtime.block_on(actor.flush(DEADLINE)).unwrap();
        }
        most
    });
    eprintln!("{chunks} chunks of each of {ACTORS} actors");
    if capacity_steps == u64::MAX {
        check(folder.path(), chunks);
    }
    let report = inspect(folder.path()).unwrap();
    assert_eq!(report.damage, []);
    assert_eq!(
        report.inserted_steps,
        chunks * ACTORS * u64::from(STEPS),
        "counted once"
    );
    assert!(report.actors.iter().all(|actor| actor.next_seq == chunks));
}

fn start_actors(runtime: &Runtime, address: &str) -> Vec<AppendClient> {
    let _inside = runtime.enter();
    (0..ACTORS).map(|number| actor(address, number)).collect()
}

/// Sends chunks of actor `number` until it is enough; how many.
fn send_until(actor: &AppendClient, number: u64, enough: &AtomicBool) -> u64 {
    let mut seq = 0;
    while !enough.load(Ordering::Relaxed) {
        actor.send_blocking(chunk(number, seq)).unwrap();
        seq += 1;
        std::thread::sleep(Duration::from_millis(2));
    }
    seq
}

/// Ends waiting senders where a test fails, or its scope would wait for ever.
struct StopSending<'a> {
    enough: &'a AtomicBool,
    actors: &'a [AppendClient],
}

impl Drop for StopSending<'_> {
    fn drop(&mut self) {
        self.enough.store(true, Ordering::Relaxed);
        for actor in self.actors {
            actor.close();
        }
    }
}

/// Every actor's episode holds its `chunks` chunks, each once, in order, byte for byte.
fn check(folder: &Path, chunks: u64) {
    let (_, store, recovery) = Store::open(folder, &StoreOptions::default()).unwrap();
    assert_eq!(recovery.quarantined, []);
    assert_eq!(recovery.chunks, chunks * ACTORS);
    let table = Table::new("any", Selector::Episodes);
    let mut sampler = store.sampler(&table, chunks as u32 * STEPS, 1).unwrap();
    let mut seen = BTreeSet::new();
    while seen.len() < ACTORS as usize {
        let whole = sampler.draw().unwrap();
        if seen.insert(whole.episode_id) {
            assert_eq!(whole.chunks.len() as u64, chunks);
            for (seq, place) in (0..).zip(&whole.chunks) {
                let found = place.read().unwrap();
                let sent = Chunk {
                    epoch: found.epoch,
                    ..chunk(whole.episode_id, seq)
                };
                assert_eq!(found, sent);
            }
        }
    }
}
