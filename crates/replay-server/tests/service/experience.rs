//! Experience through a real server: what is acknowledged is there, exactly once, whatever dies.

use std::time::{Duration, Instant};

use crate::common::{DEADLINE, NO_LIMIT, STEPS, Server, actor, chunk, learner, payload, sampling};
use isodream_proto::v1::ReplayStatusRequest;
use isodream_replay::{LimiterOptions, Selector, Store, StoreOptions, Table};
use isodream_rpc::{AppendClient, SampleClient};

#[test]
fn what_is_acknowledged_is_sampled_byte_for_byte() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let actor = actor(&server.address, 8);
        for index in 0..20 {
            actor.send(chunk(index)).await.unwrap();
        }
        actor.flush(DEADLINE).await.unwrap();
        assert_eq!(actor.unacknowledged(), 0);
        assert_eq!(actor.acknowledged_chunks(), 20);
        assert_eq!(actor.waiting(), None);

        let mut learner = learner(&server.address, 25);
        for draw in 1..=50_u64 {
            let sequence = learner.next().await.unwrap();
            assert_eq!(sequence.sampled_steps, draw * 25);
            let first = sequence.chunks[0].first_step;
            assert!(sequence.offset < STEPS);
            assert!((3..=4).contains(&sequence.chunks.len()));
            for (at, found) in sequence.chunks.iter().enumerate() {
                let index = u64::from(first / STEPS) + at as u64;
                let mut sent = chunk(index);
                sent.actor_id = "actor-0".into();
                sent.epoch = found.epoch;
                sent.seq = index;
                assert_eq!(*found, sent);
            }
        }
        assert_eq!(learner.waiting(), None);

        let mut client = isodream_rpc::Dialer::default()
            .replay(&server.address)
            .unwrap();
        let status = client
            .status(ReplayStatusRequest {})
            .await
            .unwrap()
            .into_inner();
        assert_eq!(
            (status.steps, status.episodes, status.inserted_steps),
            (200, 1, 200)
        );
        // The learner's credits reach beyond what it has taken.
        assert!(status.sampled_steps >= 1250, "{status:?}");
        assert!(status.bytes > 20 * 300);
        assert_eq!(status.insert_waiting, "");
        assert_eq!(status.sample_waiting, "");
    });
    server.stop().unwrap();
}

#[test]
fn a_server_that_dies_again_and_again_keeps_every_acknowledged_chunk_exactly_once() {
    const CHUNKS: u64 = 400;
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let address = server.address.clone();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let actor = runtime.block_on(async { actor(&address, 8) });
    let server = std::thread::scope(|scope| {
        let _end_the_sender = CloseOnDrop(&actor);
        let mut server = server;
        let sender = scope.spawn(|| {
            for index in 0..CHUNKS {
                actor.send_blocking(chunk(index)).unwrap();
            }
        });
        for death in 1..=4 {
            // With chunks on their way: the spool is full while the server lives.
            let since = Instant::now();
            while actor.acknowledged_chunks() < death * CHUNKS / 8 && since.elapsed() < DEADLINE {
                std::thread::sleep(Duration::from_millis(1));
            }
            let acknowledged = actor.acknowledged_chunks();
            server.kill();
            server = Server::start_on(&address, folder.path(), NO_LIMIT);
            let inserted = runtime.block_on(inserted_steps(&address));
            assert!(
                inserted >= acknowledged * u64::from(STEPS),
                "{acknowledged} chunks acknowledged, {inserted} steps found"
            );
        }
        sender.join().unwrap();
        server
    });
    runtime.block_on(actor.flush(DEADLINE)).unwrap();
    drop(actor);
    server.stop().unwrap();

    let (_, store, recovery) = Store::open(folder.path(), &StoreOptions::default()).unwrap();
    assert_eq!(recovery.chunks, CHUNKS);
    assert!(recovery.quarantined.is_empty());
    // One unbroken episode of all steps is every chunk, once, in order.
    let steps = Table::new("any", Selector::Steps);
    let mut sampler = store.sampler(&steps, CHUNKS as u32 * STEPS, 0).unwrap();
    let whole = sampler.draw().unwrap();
    assert_eq!(whole.chunks.len() as u64, CHUNKS);
    for (index, place) in (0..).zip(&whole.chunks) {
        let found = place.read().unwrap();
        assert_eq!((found.seq, found.payload), (index, payload(index)));
    }
}

/// Ends a waiting sender where the test fails, or its scope would wait for ever.
struct CloseOnDrop<'a>(&'a AppendClient);

impl Drop for CloseOnDrop<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}

pub(crate) async fn inserted_steps(address: &str) -> u64 {
    let mut client = isodream_rpc::Dialer::default().replay(address).unwrap();
    client
        .status(ReplayStatusRequest {})
        .await
        .unwrap()
        .into_inner()
        .inserted_steps
}

#[test]
fn an_actor_outlives_a_reset_of_the_store() {
    let first = tempfile::tempdir().unwrap();
    let server = Server::start(first.path(), NO_LIMIT);
    let address = server.address.clone();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let actor = runtime.block_on(async { actor(&address, 8) });
    runtime.block_on(async {
        actor.send(chunk(0)).await.unwrap();
        actor.flush(DEADLINE).await.unwrap();
    });
    server.stop().unwrap();
    let second = tempfile::tempdir().unwrap();
    let server = Server::start_on(&address, second.path(), NO_LIMIT);
    runtime.block_on(async {
        actor.send(chunk(1)).await.unwrap();
        actor.flush(DEADLINE).await.unwrap();
        assert_eq!(inserted_steps(&address).await, u64::from(STEPS));
    });
    server.stop().unwrap();
}

#[test]
fn a_learner_goes_on_over_a_restart_with_its_count() {
    let limiter = LimiterOptions {
        min_steps: 10,
        samples_per_insert: 2.0,
        tolerance_steps: 100.0,
    };
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), limiter.clone());
    let address = server.address.clone();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let mut learner = runtime.block_on(async {
        let actor = actor(&address, 8);
        for index in 0..6 {
            actor.send(chunk(index)).await.unwrap();
        }
        actor.flush(DEADLINE).await.unwrap();
        learner(&address, 10)
    });
    // Due: (60 - 10) * 2 = 100, tolerance 100: draws go on until the surplus is below -100.
    let allowed = 21;
    let mut taken = 0;
    runtime.block_on(async {
        for _ in 0..10 {
            taken += 10;
            assert_eq!(learner.next().await.unwrap().sampled_steps, taken);
        }
    });
    server.kill();
    let server = Server::start_on(&address, folder.path(), limiter);
    runtime.block_on(async {
        for _ in 10..allowed {
            taken += 10;
            assert_eq!(learner.next().await.unwrap().sampled_steps, taken);
        }
        let why = crate::common::until("the learner has to wait", || learner.waiting()).await;
        assert!(why.contains("actors are behind"), "{why}");
        assert_eq!(learner.buffered(), 0, "the restart gave nothing away");
    });
    server.stop().unwrap();
}

#[test]
fn pretraining_does_not_count() {
    let limiter = LimiterOptions {
        min_steps: 10,
        samples_per_insert: 1.0,
        tolerance_steps: 10.0,
    };
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), limiter);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let actor = actor(&server.address, 8);
        actor.send(chunk(0)).await.unwrap();
        let mut options = sampling(&server.address, 10);
        options.unlimited_sequences = 9;
        let mut learner = SampleClient::start(&isodream_rpc::Dialer::default(), options).unwrap();
        for _ in 0..9 {
            assert_eq!(learner.next().await.unwrap().sampled_steps, 0);
        }
        assert_eq!(learner.next().await.unwrap().sampled_steps, 10);
        assert_eq!(learner.next().await.unwrap().sampled_steps, 20);
        let why = crate::common::until("the learner has to wait", || learner.waiting()).await;
        assert!(why.contains("20 steps sampled"), "{why}");
    });
    server.stop().unwrap();
}
