//! A real server on loopback, in a runtime of its own so that it can die at any await point.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::time::{Duration, Instant};

use bytes::Bytes;
use isodream_core::{Chunk, EnvSpec, ImageShape};
use isodream_proto::Identity;
use isodream_replay::{Capacity, LimiterOptions, Selector, Store, StoreOptions, Table};
use isodream_replay_server::{ServedTable, ServerOptions, serve};
use isodream_rpc::{AppendClient, AppendOptions, RpcError, SampleClient, SampleOptions};
use tokio::runtime::Runtime;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

/// Longer than anything here takes on a busy machine.
pub(crate) const DEADLINE: Duration = Duration::from_secs(30);
/// Steps per chunk.
pub(crate) const STEPS: u32 = 10;

pub(crate) const NO_LIMIT: LimiterOptions = LimiterOptions {
    min_steps: 0,
    samples_per_insert: 0.0,
    tolerance_steps: 0.0,
};

pub(crate) struct Server {
    pub(crate) address: String,
    runtime: Runtime,
    shutdown: CancellationToken,
    running: JoinHandle<anyhow::Result<()>>,
}

impl Server {
    /// Starts a server on a free port.
    pub(crate) fn start(folder: &Path, limiter: LimiterOptions) -> Self {
        Self::start_on("127.0.0.1:0", folder, limiter)
    }

    /// Starts a server, once the folder and the address of its predecessor are free.
    pub(crate) fn start_on(address: &str, folder: &Path, limiter: LimiterOptions) -> Self {
        let runtime = Runtime::new().unwrap();
        let options = ServerOptions {
            folder: folder.to_owned(),
            store: StoreOptions {
                capacity: Capacity::UNLIMITED,
                segment_bytes: 8192,
            },
            limiter,
            relay_policy: None,
            tables: tables(),
            door: isodream_rpc::Door::default(),
        };
        let since = Instant::now();
        loop {
            let listener = match runtime
                .block_on(isodream_rpc::bind(address, &isodream_rpc::Door::default()))
            {
                Ok(listener) => listener,
                // The predecessor's runtime lets go of it in its own time.
                Err(RpcError::InUse { .. }) if since.elapsed() < DEADLINE => {
                    std::thread::sleep(Duration::from_millis(10));
                    continue;
                }
                Err(error) => panic!("{error}"),
            };
            let address = listener.local_addr().unwrap().to_string();
            let shutdown = CancellationToken::new();
            let running = runtime.spawn(serve(options.clone(), listener, shutdown.clone()));
            let up = runtime.block_on(async {
                let mut client = isodream_rpc::Dialer::default().replay(&address).unwrap();
                while !running.is_finished() {
                    if client
                        .status(isodream_proto::v1::ReplayStatusRequest {})
                        .await
                        .is_ok()
                    {
                        return true;
                    }
                    tokio::time::sleep(Duration::from_millis(10)).await;
                }
                false
            });
            if up {
                return Self {
                    address,
                    runtime,
                    shutdown,
                    running,
                };
            }
            assert!(since.elapsed() < DEADLINE, "the folder stays locked");
        }
    }

    /// Drops everything at whatever await point it is.
    pub(crate) fn kill(self) {
        self.runtime.shutdown_background();
    }

    /// Shuts down as a signal would.
    pub(crate) fn stop(self) -> anyhow::Result<()> {
        self.shutdown.cancel();
        self.runtime
            .block_on(async { tokio::time::timeout(DEADLINE, self.running).await })
            .unwrap()
            .unwrap()
    }
}

/// What every server here serves; only `train` is limited.
fn tables() -> Vec<ServedTable> {
    [
        ("train", Selector::Episodes),
        ("hard", Selector::Prioritized { exponent: 1.0 }),
        ("queue", Selector::Fifo),
    ]
    .map(|(name, selector)| ServedTable {
        table: Table::new(name, selector),
        limited: name == "train",
    })
    .into()
}

pub(crate) fn spec(id: &str) -> EnvSpec {
    EnvSpec {
        id: id.to_owned(),
        image: ImageShape {
            height: 2,
            width: 2,
            channels: 3,
        },
        action_dim: 2,
        action_repeat: 1,
        time_limit: 100,
    }
}

pub(crate) fn identity(id: &str) -> Identity {
    Identity::new(&spec(id), "")
}

pub(crate) fn actor(address: &str, spool_chunks: usize) -> AppendClient {
    AppendClient::start(
        &isodream_rpc::Dialer::default(),
        appending(address, spool_chunks),
    )
    .unwrap()
}

pub(crate) fn appending(address: &str, spool_chunks: usize) -> AppendOptions {
    AppendOptions {
        addresses: vec![address.to_owned()],
        identity: identity("highway/day"),
        actor_id: "actor-0".into(),
        spool_chunks,
        spool_bytes: usize::MAX,
        failover_after: isodream_rpc::limits::FAILOVER_AFTER,
    }
}

pub(crate) fn sampling(address: &str, sequence_length: u32) -> SampleOptions {
    SampleOptions {
        addresses: vec![address.to_owned()],
        identity: identity("highway/day"),
        sequence_length,
        table: "train".into(),
        learner_epoch: 0,
        seed: 1,
        prefetch: 4,
        sampled_steps: BTreeMap::new(),
        unlimited_sequences: 0,
    }
}

pub(crate) fn learner(address: &str, sequence_length: u32) -> SampleClient {
    SampleClient::start(
        &isodream_rpc::Dialer::default(),
        sampling(address, sequence_length),
    )
    .unwrap()
}

/// Chunk `index` of one long episode; numbers are the client's business.
pub(crate) fn chunk(index: u64) -> Chunk {
    Chunk {
        actor_id: String::new(),
        epoch: 0,
        seq: 0,
        episode_id: 77,
        first_step: index as u32 * STEPS,
        steps: STEPS,
        ends_episode: false,
        payload: payload(index),
    }
}

pub(crate) fn payload(index: u64) -> Bytes {
    (0..300_u64).map(|byte| (byte * 31 + index) as u8).collect()
}

/// First steps of all chunks in a folder whose server is gone.
pub(crate) fn first_steps(folder: &Path) -> Vec<u32> {
    let (_, store, recovery) = Store::open(folder, &StoreOptions::default()).unwrap();
    let table = Table::new("any", Selector::Episodes);
    let mut sampler = store.sampler(&table, STEPS, 0).unwrap();
    let mut found = BTreeSet::new();
    // More than enough draws to see each of the few chunks.
    for _ in 0..recovery.chunks * 200 {
        for place in sampler.draw().unwrap().chunks {
            let read = place.read().unwrap();
            assert_eq!(read.payload, payload(u64::from(read.first_step / STEPS)));
            found.insert(read.first_step);
        }
    }
    assert_eq!(
        found.len() as u64,
        recovery.chunks,
        "a chunk is there twice"
    );
    found.into_iter().collect()
}

/// Waits until `condition` holds.
pub(crate) async fn until<T>(what: &str, mut condition: impl FnMut() -> Option<T>) -> T {
    let since = Instant::now();
    loop {
        if let Some(value) = condition() {
            return value;
        }
        assert!(since.elapsed() < DEADLINE, "waited too long: {what}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}
