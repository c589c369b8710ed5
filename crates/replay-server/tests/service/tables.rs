//! Several tables over the same chunks, and priorities that travel back.

use crate::common::{DEADLINE, NO_LIMIT, STEPS, Server, actor, chunk, sampling, until};
use isodream_proto::v1::{ReplayStatus, ReplayStatusRequest};
use isodream_replay::LimiterOptions;
use isodream_rpc::{PriorityUpdate, RpcError, SampleClient};

fn learner(server: &Server, table: &str, length: u32) -> SampleClient {
    let mut options = sampling(&server.address, length);
    options.table = table.into();
    SampleClient::start(&isodream_rpc::Dialer::default(), options).unwrap()
}

async fn insert(server: &Server, chunks: u64) {
    let actor = actor(&server.address, 8);
    for index in 0..chunks {
        actor.send(chunk(index)).await.unwrap();
    }
    actor.flush(DEADLINE).await.unwrap();
}

async fn status(server: &Server) -> ReplayStatus {
    let mut client = isodream_rpc::Dialer::default()
        .replay(&server.address)
        .unwrap();
    let status = client.status(ReplayStatusRequest {}).await;
    status.unwrap().into_inner()
}

async fn refusal(client: &mut SampleClient) -> String {
    loop {
        match tokio::time::timeout(DEADLINE, client.next()).await.unwrap() {
            Ok(_) => {}
            Err(RpcError::Refused { reason, .. }) => return reason,
            Err(error) => panic!("{error}"),
        }
    }
}

#[test]
fn an_unknown_table_is_refused_with_the_known_names() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let words = refusal(&mut learner(&server, "trian", 5)).await;
        assert_eq!(
            words,
            "there is no replay table `trian`; known: train, hard, queue"
        );
    });
    server.stop().unwrap();
}

#[test]
fn a_queue_gives_every_sequence_once_and_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        insert(&server, 2).await;
        let mut learner = learner(&server, "queue", 8);
        for start in 0..=2 * STEPS - 8 {
            let drawn = learner.next().await.unwrap();
            assert_eq!((drawn.episode_id, drawn.start_step), (77, start));
            assert_eq!(drawn.chunks[0].first_step + drawn.offset, start);
        }
        let why = until("the queue is empty", || learner.waiting()).await;
        assert!(why.contains("all were drawn"), "{why}");
    });
    server.stop().unwrap();
}

#[test]
fn draws_follow_the_priorities_that_were_sent() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        insert(&server, 1).await;
        let mut learner = learner(&server, "hard", STEPS - 1);
        let drawn = learner.next().await.unwrap();
        assert_eq!(drawn.probability, 0.5, "two sequences, both new");
        let update = |start_step, priority| PriorityUpdate {
            store_id: drawn.store_id.clone(),
            episode_id: 77,
            start_step,
            priority,
        };
        let updates = vec![update(0, 0.0), update(1, 3.0), update(2, 1.0)];
        learner.update_priorities(updates).await.unwrap();
        let since = std::time::Instant::now();
        loop {
            let status = status(&server).await;
            if status.priority_updates + status.ignored_priority_updates == 3 {
                assert_eq!(
                    status.ignored_priority_updates, 1,
                    "start step 2 ends outside"
                );
                break;
            }
            assert!(since.elapsed() < DEADLINE, "{status:?}");
        }
        // What was drawn before the update may still be on its way: as much as was prefetched.
        for _ in 0..20 {
            learner.next().await.unwrap();
        }
        for _ in 0..20 {
            let drawn = learner.next().await.unwrap();
            assert_eq!((drawn.start_step, drawn.probability), (1, 1.0));
        }
    });
    server.stop().unwrap();
}

#[test]
fn priorities_that_make_no_sense_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        insert(&server, 1).await;
        for (table, priority, words) in [
            ("hard", f32::NAN, "out of range"),
            ("hard", -1.0, "out of range"),
            ("train", 1.0, "`train` has no priorities"),
        ] {
            let mut learner = learner(&server, table, 5);
            // The server is known once it has sent something.
            let drawn = learner.next().await.unwrap();
            let update = PriorityUpdate {
                store_id: drawn.store_id,
                episode_id: 77,
                start_step: 0,
                priority,
            };
            learner.update_priorities(vec![update]).await.unwrap();
            let reason = refusal(&mut learner).await;
            assert!(reason.contains(words), "{reason}");
        }
    });
    server.stop().unwrap();
}

#[test]
fn only_the_limited_tables_draws_count() {
    let limiter = LimiterOptions {
        min_steps: 10,
        samples_per_insert: 1.0,
        tolerance_steps: 10.0,
    };
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), limiter);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        insert(&server, 1).await;
        let mut train = learner(&server, "train", 10);
        for _ in 0..2 {
            train.next().await.unwrap();
        }
        let why = until("the learner has to wait", || train.waiting()).await;
        assert!(why.contains("20 steps sampled"), "{why}");
        let mut other = learner(&server, "hard", 5);
        for _ in 0..50 {
            other.next().await.unwrap();
        }
        let status = status(&server).await;
        assert_eq!(status.sampled_steps, 20, "neither counted nor reset");
    });
    server.stop().unwrap();
}
