//! Replay over a simulated network: two real servers over real stores, three actors, a learner; messages are
//! late or lost, hosts are cut off, every process dies and comes back.
//!
//! A seed fixes the faults, the messages' delays and what the roles decide. Two things follow the machine's own
//! clock: the commit thread of each server, and the jitter of reconnections; so a seed narrows a failure down
//! without repeating every interleaving. `ISODREAM_SIMULATION_SEED=N` runs one seed alone.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod network;
mod record;
mod roles;

use std::panic::AssertUnwindSafe;
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use record::Shared;
use roles::SERVERS;
use tokio_util::sync::CancellationToken;
use turmoil::{Builder, Sim};

const ACTORS: usize = 3;
const TICK: Duration = Duration::from_millis(5);
/// Simulated time with faults.
const FAULTS: Duration = Duration::from_secs(15);
/// Simulated time without them after which everything is durable, unless the machine's own disk is slow.
const SETTLING: Duration = Duration::from_secs(300);
/// Real time that a slow disk is given.
const SLOW_DISK: Duration = Duration::from_secs(60);

fn hosts() -> Vec<String> {
    let actors = (0..ACTORS).map(record::name);
    actors.chain(["learner".to_owned()]).collect()
}

/// What is broken at the moment, and is mended some time later.
enum Broken {
    Partition(String, &'static str),
    Held(String, &'static str),
    Crashed(String),
}

impl Broken {
    fn one(sim: &mut Sim, rng: &mut ChaCha8Rng, shared: &Shared) -> Self {
        let hosts = hosts();
        let host = hosts[rng.random_range(0..hosts.len())].clone();
        let server = SERVERS[rng.random_range(0..SERVERS.len())];
        match rng.random_range(0..6) {
            0 => {
                sim.partition(host.as_str(), server);
                Self::Partition(host, server)
            }
            1 | 2 => {
                sim.hold(host.as_str(), server);
                Self::Held(host, server)
            }
            3 | 4 => {
                sim.crash(server);
                Self::Crashed(server.to_owned())
            }
            _ => {
                sim.crash(host.as_str());
                if host != "learner" {
                    shared.lock().unwrap().actors_lost += 1;
                }
                Self::Crashed(host)
            }
        }
    }

    fn mend(self, sim: &mut Sim) {
        match self {
            Self::Partition(host, server) => sim.repair(host, server),
            Self::Held(host, server) => sim.release(host, server),
            Self::Crashed(host) => sim.bounce(host),
        }
    }
}

fn simulate(seed: u64) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let folders = SERVERS.map(|_| tempfile::tempdir().unwrap());
    let shared = Shared::default();
    let stop = CancellationToken::new();
    let mut sim = Builder::new()
        .rng_seed(rng.random())
        .tick_duration(TICK)
        .simulation_duration(Duration::MAX)
        .min_message_latency(Duration::from_millis(1))
        .max_message_latency(Duration::from_millis(rng.random_range(2..200)))
        .tcp_capacity(1 << 16)
        .build();
    for (server, folder) in SERVERS.iter().zip(&folders) {
        let folder = folder.path().to_owned();
        sim.host(*server, move || roles::server(folder.clone()));
    }
    for number in 0..ACTORS {
        let (shared, stop, seed) = (shared.clone(), stop.clone(), rng.random());
        sim.host(record::name(number), move || {
            roles::actor(number, seed, shared.clone(), stop.clone())
        });
    }
    let (drawing, draws) = (shared.clone(), rng.random());
    sim.host("learner", move || roles::learner(draws, drawing.clone()));

    let mut broken: Option<(Broken, Duration)> = None;
    let mut next = Duration::from_millis(rng.random_range(0..2000));
    while sim.elapsed() < FAULTS {
        sim.step().unwrap();
        let now = sim.elapsed();
        match broken.take() {
            Some((fault, until)) if until > now => broken = Some((fault, until)),
            Some((fault, _)) => {
                fault.mend(&mut sim);
                next = now + Duration::from_millis(rng.random_range(0..1500));
            }
            None if now >= next => {
                let until = now + Duration::from_millis(rng.random_range(0..5000));
                broken = Some((Broken::one(&mut sim, &mut rng, &shared), until));
            }
            None => {}
        }
    }
    if let Some((fault, _)) = broken {
        fault.mend(&mut sim);
    }
    stop.cancel();
    let settling = Instant::now();
    while shared.lock().unwrap().actors_done < ACTORS {
        sim.step().unwrap();
        if sim.elapsed() - FAULTS > SETTLING {
            // Simulated minutes pass in a second, in which a commit thread may not even have had the processor.
            std::thread::sleep(Duration::from_millis(1));
            let waited = settling.elapsed();
            assert!(waited < SLOW_DISK, "not everything became durable");
        }
    }
    drop(sim);
    let record = shared.lock().unwrap();
    record.check_stores(&folders.each_ref().map(|folder| folder.path()));
    assert!(!record.acknowledged.is_empty() && record.sequences > 0);
}

/// Runs `seeds`, or those among them that are asked for, and names the one that fails.
fn simulate_all(seeds: std::ops::Range<u64>) {
    let only = std::env::var("ISODREAM_SIMULATION_SEED").ok();
    let only: Option<u64> = only.map(|seed| seed.parse().unwrap());
    for seed in seeds.filter(|seed| only.is_none_or(|only| only == *seed)) {
        if let Err(panic) = std::panic::catch_unwind(AssertUnwindSafe(|| simulate(seed))) {
            println!("seed {seed} failed; ISODREAM_SIMULATION_SEED={seed} runs it alone");
            std::panic::resume_unwind(panic);
        }
    }
}

#[test]
fn nothing_acknowledged_is_lost_or_stored_twice_with_seeds_0_to_49() {
    simulate_all(0..50);
}

#[test]
fn nothing_acknowledged_is_lost_or_stored_twice_with_seeds_50_to_99() {
    simulate_all(50..100);
}
