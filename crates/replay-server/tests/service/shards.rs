//! Several replay-servers: actors that move, a learner that draws from all.

use std::collections::BTreeMap;
use std::time::Duration;

use isodream_replay::LimiterOptions;
use isodream_rpc::{AppendClient, SampleClient};
use tokio::runtime::Runtime;

use crate::common::{
    DEADLINE, NO_LIMIT, STEPS, Server, appending, chunk, first_steps, sampling, until,
};

#[test]
fn an_actor_moves_to_the_next_server_and_no_step_is_lost_or_stored_twice() {
    const CHUNKS: u64 = 40;
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let mut servers = folders
        .each_ref()
        .map(|folder| Some(Server::start(folder.path(), NO_LIMIT)));
    let addresses = servers
        .each_ref()
        .map(|server| server.as_ref().unwrap().address.clone());
    let runtime = Runtime::new().unwrap();
    let actor = runtime.block_on(async {
        let mut options = appending("", 8);
        options.addresses = addresses.to_vec();
        options.failover_after = Duration::from_millis(300);
        AppendClient::start(&isodream_rpc::Dialer::default(), options).unwrap()
    });
    runtime.block_on(async {
        actor.send(chunk(0)).await.unwrap();
        actor.flush(DEADLINE).await.unwrap();
    });
    let inserted = |address: &String| {
        let steps = runtime.block_on(crate::experience::inserted_steps(address));
        usize::from(steps > 0)
    };
    let home = addresses
        .each_ref()
        .map(inserted)
        .iter()
        .position(|n| *n > 0)
        .unwrap();
    // Its home dies with chunks on their way.
    std::thread::scope(|scope| {
        let sending = scope.spawn(|| {
            for index in 1..CHUNKS {
                actor.send_blocking(chunk(index)).unwrap();
            }
        });
        servers[home].take().unwrap().kill();
        sending.join().unwrap();
    });
    let other = 1 - home;
    assert_eq!(inserted(&addresses[other]), 1);
    // What the home was sent waits for it, and comes when it is back.
    servers[home] = Some(Server::start_on(
        &addresses[home],
        folders[home].path(),
        NO_LIMIT,
    ));
    runtime.block_on(actor.flush(DEADLINE)).unwrap();
    assert_eq!(actor.acknowledged_chunks(), CHUNKS);
    drop(actor);
    for server in servers.into_iter().flatten() {
        server.stop().unwrap();
    }
    let mut all: Vec<u32> = folders
        .iter()
        .flat_map(|folder| first_steps(folder.path()))
        .collect();
    all.sort_unstable();
    let expected: Vec<u32> = (0..CHUNKS as u32).map(|index| index * STEPS).collect();
    assert_eq!(all, expected, "each step once, in one of the two stores");
}

#[test]
fn a_learner_draws_from_all_servers_and_from_those_that_are_left() {
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let servers = folders
        .each_ref()
        .map(|folder| Server::start(folder.path(), NO_LIMIT));
    let runtime = Runtime::new().unwrap();
    let (mut learner, stores) = runtime.block_on(async {
        for (server, chunks) in servers.iter().zip([30, 10]) {
            let actor = crate::common::actor(&server.address, 8);
            for index in 0..chunks {
                actor.send(chunk(index)).await.unwrap();
            }
            actor.flush(DEADLINE).await.unwrap();
        }
        let mut options = sampling("", 10);
        options.addresses = servers
            .iter()
            .map(|server| server.address.clone())
            .collect();
        options.prefetch = 50;
        let mut learner = SampleClient::start(&isodream_rpc::Dialer::default(), options).unwrap();
        until("both servers are known", || {
            (learner.watch().inserted_steps() == 400).then_some(())
        })
        .await;
        // The first ones may have been asked for while only one was known.
        for _ in 0..50 {
            learner.next().await.unwrap();
        }
        let mut stores = BTreeMap::<_, u64>::new();
        for _ in 0..1000 {
            let sequence = learner.next().await.unwrap();
            *stores.entry(sequence.store_id).or_default() += 1;
        }
        (learner, stores)
    });
    assert_eq!(stores.len(), 2);
    let larger = stores.values().copied().max().unwrap();
    // Expected 750; five standard deviations are 69.
    assert!((681..=819).contains(&larger), "{larger} of 1000");
    let [first, second] = servers;
    first.kill();
    runtime.block_on(async {
        for _ in 0..200 {
            tokio::time::timeout(DEADLINE, learner.next())
                .await
                .unwrap()
                .unwrap();
        }
        assert_eq!(learner.waiting(), None, "one of two is enough");
    });
    second.stop().unwrap();
}

#[test]
fn a_server_whose_limiter_waits_holds_nobody_up() {
    let limiter = LimiterOptions {
        min_steps: 10,
        samples_per_insert: 1.0,
        tolerance_steps: 20.0,
    };
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let servers = [
        Server::start(folders[0].path(), limiter),
        Server::start(folders[1].path(), NO_LIMIT),
    ];
    let runtime = Runtime::new().unwrap();
    runtime.block_on(async {
        for server in &servers {
            let actor = crate::common::actor(&server.address, 8);
            actor.send(chunk(0)).await.unwrap();
            actor.send(chunk(1)).await.unwrap();
            actor.flush(DEADLINE).await.unwrap();
        }
        let mut options = sampling("", 10);
        options.addresses = servers
            .iter()
            .map(|server| server.address.clone())
            .collect();
        let mut learner = SampleClient::start(&isodream_rpc::Dialer::default(), options).unwrap();
        let mut counts = BTreeMap::<_, u64>::new();
        for _ in 0..300 {
            let next = tokio::time::timeout(DEADLINE, learner.next())
                .await
                .unwrap();
            *counts.entry(next.unwrap().store_id).or_default() += 1;
        }
        // 10 steps are due and 20 tolerated: 4 draws of 10 steps.
        assert_eq!(counts.values().min(), Some(&4), "{counts:?}");
    });
    for server in servers {
        server.stop().unwrap();
    }
}
