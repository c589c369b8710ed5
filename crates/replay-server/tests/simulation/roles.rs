//! The processes of a simulation: real servers, real clients.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use isodream_core::{EnvSpec, ImageShape};
use isodream_proto::Identity;
use isodream_replay::{Capacity, LimiterOptions, Selector, StoreOptions, Table};
use isodream_replay_server::{ServedTable, ServerOptions, serve_connections};
use isodream_rpc::{
    AppendClient, AppendOptions, Dialer, Door, RpcError, SampleClient, SampleOptions,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio_util::sync::CancellationToken;
use turmoil::net::TcpListener;

use crate::network::{PORT, Simulated, connections};
use crate::record::{self, Shared};

/// Steps per chunk.
pub(crate) const STEPS: u32 = 10;
/// Steps per sequence.
pub(crate) const LENGTH: u32 = 25;
pub(crate) const PREFETCH: usize = 8;
pub(crate) const SPOOL_CHUNKS: usize = 4;
pub(crate) const SERVERS: [&str; 2] = ["replay-0", "replay-1"];
pub(crate) const LIMITER: LimiterOptions = LimiterOptions {
    min_steps: 50,
    samples_per_insert: 4.0,
    tolerance_steps: 300.0,
};

pub(crate) type Ended = turmoil::Result;

fn identity() -> Identity {
    let image = ImageShape {
        height: 2,
        width: 2,
        channels: 3,
    };
    let spec = EnvSpec {
        id: "simulated".into(),
        image,
        action_dim: 1,
        action_repeat: 1,
        time_limit: 100,
    };
    Identity::new(&spec, "")
}

fn addresses() -> Vec<String> {
    SERVERS.map(|server| format!("{server}:{PORT}")).to_vec()
}

/// Serves a folder, once the predecessor's thread has let go of it.
pub(crate) async fn server(folder: PathBuf) -> Ended {
    loop {
        let listener = TcpListener::bind(("0.0.0.0", PORT)).await?;
        let options = ServerOptions {
            folder: folder.clone(),
            store: StoreOptions {
                capacity: Capacity::UNLIMITED,
                segment_bytes: 8192,
            },
            limiter: LIMITER,
            relay_policy: None,
            tables: vec![ServedTable {
                table: Table::new("train", Selector::Episodes),
                limited: true,
            }],
            door: Door::default(),
        };
        let never = CancellationToken::new();
        let served = serve_connections(options, connections(listener), never).await;
        match served {
            Err(error) if error.to_string().contains("in use") => {
                std::thread::sleep(Duration::from_millis(1));
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
            other => panic!("a server ended: {other:?}"),
        }
    }
}

fn append_client(actor: usize) -> AppendClient {
    let options = AppendOptions {
        addresses: addresses(),
        identity: identity(),
        actor_id: record::name(actor),
        spool_chunks: SPOOL_CHUNKS,
        spool_bytes: usize::MAX,
        failover_after: Duration::from_secs(3),
    };
    AppendClient::start(&Dialer::over(Arc::new(Simulated)), options).expect("valid addresses")
}

/// Sends until it is told to stop, then until everything is durable. Now and then its successor starts while
/// it still sends. It is started anew where it is refused, as by a supervisor: a process that reached no store before
/// its successor did may be taken for the newer one.
pub(crate) async fn actor(
    number: usize,
    seed: u64,
    shared: Shared,
    stop: CancellationToken,
) -> Ended {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    loop {
        let start = {
            let mut record = shared.lock().expect("no panic");
            let start = record.starts.entry(number).or_default();
            *start += 1;
            *start
        };
        let client = append_client(number);
        let count = rng.random_range(20..100_u32);
        let mut sent = 0;
        let mut refused = false;
        while sent < count && !stop.is_cancelled() {
            match client.send(record::chunk((number, start, sent))).await {
                Err(RpcError::Refused { .. }) => {
                    refused = true;
                    break;
                }
                handed_over => handed_over?,
            }
            sent += 1;
            if rng.random_bool(0.1) && client.flush(Duration::from_secs(10)).await.is_ok() {
                acknowledged(&shared, number, start, sent);
            }
            let pause = rng.random_range(0..60);
            tokio::time::sleep(Duration::from_millis(pause)).await;
        }
        if stop.is_cancelled() && !refused {
            match client.flush(Duration::from_secs(86_400)).await {
                Err(RpcError::Refused { .. }) => refused = true,
                flushed => {
                    flushed?;
                    acknowledged(&shared, number, start, sent);
                    shared.lock().expect("no panic").actors_done += 1;
                    return Ok(());
                }
            }
        }
        if refused {
            let mut record = shared.lock().expect("no panic");
            record.actors_lost += 1;
            record.actors_refused += 1;
            continue;
        }
        shared.lock().expect("no panic").actors_lost += 1;
        tokio::spawn(async move {
            // Half dead: it goes on until it is fenced off, or for a while at another server.
            for index in sent..sent + 20 {
                if client
                    .send(record::chunk((number, start, index)))
                    .await
                    .is_err()
                {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(30)).await;
            }
        });
    }
}

fn acknowledged(shared: &Shared, actor: usize, start: u64, sent: u32) {
    let mut record = shared.lock().expect("no panic");
    record
        .acknowledged
        .extend((0..sent).map(|index| (actor, start, index)));
}

/// Draws for ever, from where its last checkpoint was.
pub(crate) async fn learner(seed: u64, shared: Shared) -> Ended {
    let sampled_steps = shared.lock().expect("no panic").sampled_steps.clone();
    let options = SampleOptions {
        addresses: addresses(),
        identity: identity(),
        sequence_length: LENGTH,
        table: "train".into(),
        learner_epoch: 0,
        seed,
        prefetch: PREFETCH,
        sampled_steps,
        unlimited_sequences: 0,
    };
    let mut client = SampleClient::start(&Dialer::over(Arc::new(Simulated)), options)?;
    loop {
        let sequence = client.next().await?;
        record::check_sequence(&sequence);
        {
            let mut record = shared.lock().expect("no panic");
            record.sequences += 1;
            record
                .sampled_steps
                .insert(sequence.store_id.to_string(), sequence.sampled_steps);
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}
