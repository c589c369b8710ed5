//! Replay-servers that come back at other addresses, and strangers at their old ones.

use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use isodream_replay::LimiterOptions;
use isodream_rpc::{
    AppendClient, AppendOptions, Dialer, Network, Resolving, RpcError, SampleClient,
};
use tokio::runtime::Runtime;
use tonic::transport::{Channel, Endpoint};

use crate::common::{
    DEADLINE, NO_LIMIT, STEPS, Server, appending, chunk, first_steps, identity, sampling, until,
};

const NAME: &str = "replay:7001";
/// Nobody listens there.
const NOBODY: &str = "127.0.0.1:1";

/// Where [`NAME`] leads at the moment.
#[derive(Debug, Clone, Default)]
struct Names(Arc<Mutex<Vec<String>>>);

impl Names {
    fn lead_to(&self, addresses: &[&str]) {
        let addresses = addresses.iter().map(|address| (*address).to_owned());
        *self.0.lock().unwrap() = addresses.collect();
    }
}

impl Network for Names {
    fn channel(&self, endpoint: &Endpoint) -> Channel {
        endpoint.connect_lazy()
    }

    fn resolve(&self, address: String) -> Resolving {
        assert_eq!(address, NAME);
        let found = self.0.lock().unwrap().clone();
        Box::pin(async move { Ok(found.iter().map(|found| found.parse().unwrap()).collect()) })
    }
}

/// Makes `folder` the store of another environment, which refuses everybody here.
fn make_strange(folder: &Path, runtime: &Runtime) {
    let server = Server::start(folder, NO_LIMIT);
    runtime.block_on(async {
        let options = AppendOptions {
            identity: identity("walker/walk"),
            ..appending(&server.address, 1)
        };
        let actor = AppendClient::start(&Dialer::default(), options).unwrap();
        actor.send(chunk(0)).await.unwrap();
        actor.flush(DEADLINE).await.unwrap();
    });
    server.stop().unwrap();
}

#[test]
fn what_a_store_was_sent_is_brought_to_where_it_comes_back() {
    // No learner draws: the store takes a few chunks and holds the others.
    let held = LimiterOptions {
        min_steps: 0,
        samples_per_insert: 1.0,
        tolerance_steps: 40.0,
    };
    let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let [home, other, strange] = folders.each_ref().map(|folder| folder.path());
    let runtime = Runtime::new().unwrap();
    make_strange(strange, &runtime);
    let first = Server::start(home, held);
    let second = Server::start(other, NO_LIMIT);
    let names = Names::default();
    names.lead_to(&[&first.address, NOBODY]);
    let actor = runtime.block_on(async {
        let options = AppendOptions {
            // Enough to meet the stranger.
            failover_after: Duration::from_secs(3),
            ..appending(NAME, 4)
        };
        AppendClient::start(&Dialer::over(Arc::new(names.clone())), options).unwrap()
    });
    let mut sent = 1;
    runtime.block_on(async {
        actor.send(chunk(0)).await.unwrap();
        actor.flush(DEADLINE).await.unwrap();
        while let Ok(result) =
            tokio::time::timeout(Duration::from_secs(1), actor.send(chunk(sent))).await
        {
            result.unwrap();
            sent += 1;
        }
        until("the learner is behind", || {
            actor
                .waiting()
                .filter(|why| why.contains("learner is behind"))
        })
        .await;
    });
    let acknowledged = actor.acknowledged_chunks();

    // It moves, and another training's server takes its place.
    let address = first.address.clone();
    names.lead_to(&[&second.address, NOBODY]);
    first.kill();
    let stranger = Server::start_on(&address, strange, NO_LIMIT);
    runtime.block_on(async {
        for _ in 0..20 {
            actor.send(chunk(sent)).await.unwrap();
            sent += 1;
        }
        until("the other server has the rest", || {
            (actor.acknowledged_chunks() >= acknowledged + 20).then_some(())
        })
        .await;
        let flushed = actor.flush(Duration::from_secs(1)).await;
        let error = flushed.unwrap_err();
        assert!(matches!(error, RpcError::NotFlushed { .. }), "{error}");
        assert!(
            error.to_string().contains("chunks wait for the store"),
            "{error}"
        );
    });

    let back = Server::start(home, NO_LIMIT);
    assert_ne!(back.address, address);
    names.lead_to(&[NOBODY, &address, &second.address, &back.address]);
    runtime.block_on(actor.flush(DEADLINE)).unwrap();
    assert_eq!(actor.acknowledged_chunks(), sent);
    drop(actor);
    for server in [stranger, second, back] {
        server.stop().unwrap();
    }
    let mut all = [home, other].map(first_steps).concat();
    all.sort_unstable();
    let expected: Vec<u32> = (0..sent as u32).map(|index| index * STEPS).collect();
    assert_eq!(all, expected, "each step once, in one of the two stores");
    assert_eq!(first_steps(strange), [0], "its own chunk");
}

#[test]
fn a_stranger_at_the_address_of_a_server_that_moved_does_not_end_a_learner() {
    let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let [one, other, strange] = folders.each_ref().map(|folder| folder.path());
    let runtime = Runtime::new().unwrap();
    make_strange(strange, &runtime);
    let servers = [one, other].map(|folder| Server::start(folder, NO_LIMIT));
    let names = Names::default();
    names.lead_to(&servers.each_ref().map(|server| server.address.as_str()));
    let mut learner = runtime.block_on(async {
        for server in &servers {
            let actor = crate::common::actor(&server.address, 8);
            for index in 0..4 {
                actor.send(chunk(index)).await.unwrap();
            }
            actor.flush(DEADLINE).await.unwrap();
        }
        SampleClient::start(&Dialer::over(Arc::new(names.clone())), sampling(NAME, 10)).unwrap()
    });
    runtime.block_on(until("both servers are known", || {
        (learner.watch().inserted_steps() == 80).then_some(())
    }));
    let [first, second] = servers;
    let address = first.address.clone();
    names.lead_to(&[&second.address, NOBODY]);
    first.kill();
    let stranger = Server::start_on(&address, strange, NO_LIMIT);
    let gone = second.address.clone();
    second.kill();
    runtime.block_on(async {
        // What was buffered before.
        while tokio::time::timeout(Duration::from_millis(300), learner.next())
            .await
            .is_ok_and(|next| next.is_ok())
        {}
        let why = until("the stranger is left alone", || {
            learner.waiting().filter(|why| !why.contains(&address))
        })
        .await;
        assert!(why.contains(&gone), "{why}");
    });
    assert_eq!(
        learner.watch().inserted_steps(),
        80,
        "the stranger's are none of ours"
    );
    let second = Server::start_on(&gone, other, NO_LIMIT);
    runtime.block_on(async {
        for _ in 0..20 {
            tokio::time::timeout(DEADLINE, learner.next())
                .await
                .unwrap()
                .unwrap();
        }
    });
    for server in [stranger, second] {
        server.stop().unwrap();
    }
}
