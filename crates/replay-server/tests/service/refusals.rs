//! Who is refused, who waits, and what they are told.

use std::time::{Duration, Instant};

use crate::common::{
    DEADLINE, NO_LIMIT, Server, actor, appending, chunk, identity, learner, sampling, until,
};
use isodream_proto::v1::{AppendRequest, Hello, append_request::Kind};
use isodream_replay::LimiterOptions;
use isodream_rpc::{AppendClient, AppendOptions, Dialer, RpcError, SampleClient, SampleOptions};
use tonic::Code;

#[test]
fn another_environment_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let first = actor(&server.address, 8);
        first.send(chunk(0)).await.unwrap();
        first.flush(DEADLINE).await.unwrap();

        let other = AppendClient::start(
            &Dialer::default(),
            AppendOptions {
                identity: identity("walker/walk"),
                actor_id: "actor-1".into(),
                ..appending(&server.address, 1)
            },
        )
        .unwrap();
        other.send(chunk(0)).await.unwrap();
        // The spool is full and never empties: the refusal has to reach the waiting sender.
        let error = tokio::time::timeout(DEADLINE, other.send(chunk(1)))
            .await
            .unwrap()
            .unwrap_err();
        assert!(matches!(error, RpcError::Refused { .. }));
        let words = error.to_string();
        assert!(
            words.contains("walker/walk") && words.contains("highway/day"),
            "{words}"
        );
        assert_eq!(other.flush(DEADLINE).await.unwrap_err().to_string(), words);
        assert_eq!(other.waiting(), Some(words));

        let mut options = sampling(&server.address, 5);
        options.identity = identity("walker/walk");
        let mut learner = SampleClient::start(&Dialer::default(), options).unwrap();
        let error = tokio::time::timeout(DEADLINE, learner.next())
            .await
            .unwrap()
            .unwrap_err();
        assert!(error.to_string().contains("walker/walk"), "{error}");
    });
    server.stop().unwrap();
}

#[test]
fn an_older_learner_is_fenced_off_in_mid_stream_and_at_the_door() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let actor = actor(&server.address, 4);
        actor.send(chunk(0)).await.unwrap();
        actor.flush(DEADLINE).await.unwrap();
        let started = |learner_epoch| {
            let options = SampleOptions {
                learner_epoch,
                ..sampling(&server.address, 5)
            };
            SampleClient::start(&Dialer::default(), options).unwrap()
        };
        let fenced = async |learner: &mut SampleClient| {
            let refused = async {
                loop {
                    if let Err(error) = learner.next().await {
                        return error.to_string();
                    }
                }
            };
            let words = tokio::time::timeout(DEADLINE, refused).await.unwrap();
            assert!(words.contains("a newer learner"), "{words}");
        };
        let mut first = started(1);
        first.next().await.unwrap();
        let mut aside = started(0);
        let mut second = started(2);
        second.next().await.unwrap();
        fenced(&mut first).await;
        fenced(&mut started(1)).await;
        // The newest goes on, and so does who takes no part in it.
        for _ in 0..20 {
            second.next().await.unwrap();
            aside.next().await.unwrap();
        }
    });
    server.stop().unwrap();
}

#[test]
fn the_limiter_holds_actors_and_says_why() {
    let limiter = LimiterOptions {
        min_steps: 20,
        samples_per_insert: 2.0,
        tolerance_steps: 40.0,
    };
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), limiter);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let actor = actor(&server.address, 4);
        let mut learner = learner(&server.address, 10);
        let why = until("the learner waits for data", || {
            learner.waiting().filter(|why| why.contains("steps"))
        })
        .await;
        assert_eq!(why, "too little experience: 0 of 20 steps inserted");

        // The learner's prefetch of 4 x 10 steps is drawn at once; nobody takes more.
        for index in 0..4 {
            actor.send(chunk(index)).await.unwrap();
        }
        let mut sent = 4;
        let why = loop {
            let next =
                tokio::time::timeout(Duration::from_millis(500), actor.send(chunk(sent))).await;
            match next {
                Ok(result) => result.unwrap(),
                Err(_) => break actor.waiting().unwrap(),
            }
            sent += 1;
            assert!(sent < 50, "the limiter never held the actor");
        };
        assert!(why.starts_with("the learner is behind: "), "{why}");
        assert_eq!(actor.unacknowledged(), 4, "the spool is full");
        // Four are spooled, the others are inserted; held as soon as more than 40 sampled steps are due.
        let inserted = (sent - 4) * 10;
        assert!((60..=80).contains(&inserted), "{inserted} inserted: {why}");

        // Drawing frees the actor.
        let sending = actor.send(chunk(sent));
        let drawing = async {
            loop {
                learner.next().await.unwrap();
            }
        };
        tokio::select! {
            result = sending => result.unwrap(),
            () = drawing => {}
            () = tokio::time::sleep(DEADLINE) => panic!("drawing did not free the actor"),
        }
    });
    server.stop().unwrap();
}

#[test]
fn an_older_process_of_the_same_actor_is_fenced_off() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let old = actor(&server.address, 8);
        old.send(chunk(0)).await.unwrap();
        old.flush(DEADLINE).await.unwrap();
        let new = actor(&server.address, 8);
        new.send(chunk(0)).await.unwrap();
        new.flush(DEADLINE).await.unwrap();
        old.send(chunk(1)).await.unwrap();
        let error = old.flush(DEADLINE).await.unwrap_err();
        assert!(error.to_string().contains("fenced off"), "{error}");
        new.send(chunk(1)).await.unwrap();
        new.flush(DEADLINE).await.unwrap();
    });
    server.stop().unwrap();
}

#[test]
fn epochs_are_handed_out_by_the_store_and_an_older_one_is_refused_at_the_door() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let greet = async |epoch, process| {
            let hello = Hello {
                handshake: Some(identity("highway/day").handshake()),
                actor_id: "actor-0".into(),
                epoch,
                process,
                ..Hello::default()
            };
            let kind = Some(Kind::Hello(hello));
            let requests = tokio_stream::iter([AppendRequest { kind }]);
            let mut client = Dialer::default().replay(&server.address).unwrap();
            let mut replies = client.append(requests).await?.into_inner();
            Ok::<u64, tonic::Status>(replies.message().await?.expect("an answer").epoch)
        };
        let first = greet(0, 7).await.unwrap();
        assert_eq!(greet(0, 7).await.unwrap(), first, "its answer was lost");
        assert_eq!(greet(first, 7).await.unwrap(), first);
        let second = greet(0, 8).await.unwrap();
        assert!(second > first);
        let error = greet(first, 7).await.unwrap_err();
        let why = format!("epoch {first} is fenced off by epoch {second}");
        assert!(error.message().contains(&why), "{error}");
        // As if the store's clock had been set back.
        let ahead = second + (1 << 40);
        assert_eq!(greet(ahead, 9).await.unwrap(), ahead);
        assert_eq!(greet(0, 10).await.unwrap(), ahead + 1);
    });
    server.stop().unwrap();
}

#[test]
fn a_gap_is_answered_with_the_expected_number() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let hello = Hello {
            handshake: Some(identity("highway/day").handshake()),
            actor_id: "actor-0".into(),
            epoch: 1,
            ..Hello::default()
        };
        let numbered = |seq| {
            let mut chunk = chunk(seq);
            chunk.actor_id = "actor-0".into();
            chunk.epoch = 1;
            chunk.seq = seq;
            Kind::Chunk(chunk.into())
        };
        let kinds = [Kind::Hello(hello), numbered(0), numbered(1), numbered(5)];
        let requests = tokio_stream::iter(kinds.map(|kind| AppendRequest { kind: Some(kind) }));
        let mut client = Dialer::default().replay(&server.address).unwrap();
        let mut replies = client.append(requests).await.unwrap().into_inner();
        let mut durable_seq = 0;
        let status = loop {
            match replies.message().await {
                Ok(Some(reply)) => durable_seq = reply.durable_seq,
                Ok(None) => panic!("the stream ended without a reason"),
                Err(status) => break status,
            }
        };
        assert_eq!(durable_seq, 2);
        assert_eq!(status.code(), Code::Aborted);
        assert!(status.message().contains("chunk 2"), "{status}");
    });
    server.stop().unwrap();
}

#[test]
fn a_stream_without_a_hello_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let mut client = Dialer::default().replay(&server.address).unwrap();
        let kind = Some(Kind::Chunk(chunk(0).into()));
        let status = client
            .append(tokio_stream::iter([AppendRequest { kind }]))
            .await
            .unwrap_err();
        assert_eq!(status.code(), Code::FailedPrecondition);
        assert!(status.message().contains("no handshake"), "{status}");
    });
    server.stop().unwrap();
}

#[test]
fn shutting_down_with_open_streams_takes_little_time_and_clients_keep_trying() {
    let limiter = LimiterOptions {
        min_steps: 1000,
        ..NO_LIMIT
    };
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), limiter.clone());
    let address = server.address.clone();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let (actor, learner) = runtime.block_on(async {
        let actor = actor(&address, 8);
        actor.send(chunk(0)).await.unwrap();
        actor.flush(DEADLINE).await.unwrap();
        let learner = learner(&address, 10);
        until("the learner waits", || {
            learner.waiting().filter(|why| why.contains("of 1000"))
        })
        .await;
        (actor, learner)
    });
    let since = Instant::now();
    server.stop().unwrap();
    assert!(
        since.elapsed() < Duration::from_secs(2),
        "{:?}",
        since.elapsed()
    );
    runtime.block_on(async {
        let gone = |why: &String| why.contains("no working connection");
        let why = until("the actor misses its server", || {
            actor.waiting().filter(gone)
        })
        .await;
        assert!(why.contains(&address), "{why}");
        until("the learner misses its server", || {
            learner.waiting().filter(gone)
        })
        .await;
        actor.send(chunk(1)).await.unwrap();
        let error = actor.flush(Duration::from_millis(300)).await.unwrap_err();
        assert!(
            error
                .to_string()
                .starts_with("1 chunks were not acknowledged"),
            "{error}"
        );
        assert!(
            error.to_string().contains("no working connection"),
            "{error}"
        );
    });
    let server = Server::start_on(&address, folder.path(), limiter);
    runtime.block_on(async { actor.flush(DEADLINE).await.unwrap() });
    server.stop().unwrap();
}

#[test]
fn a_folder_in_use_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let options = isodream_replay_server::ServerOptions {
        folder: folder.path().to_owned(),
        store: isodream_replay::StoreOptions::default(),
        limiter: NO_LIMIT,
        relay_policy: None,
        tables: Vec::new(),
        door: isodream_rpc::Door::default(),
    };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let error = runtime.block_on(async {
        let listener = isodream_rpc::bind("127.0.0.1:0", &isodream_rpc::Door::default())
            .await
            .unwrap();
        isodream_replay_server::serve(
            options,
            listener,
            tokio_util::sync::CancellationToken::new(),
        )
        .await
        .unwrap_err()
    });
    assert!(
        error
            .to_string()
            .contains(&folder.path().display().to_string()),
        "{error}"
    );
    assert!(error.to_string().contains("in use"), "{error}");
    server.stop().unwrap();
}
