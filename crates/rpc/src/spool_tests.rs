use std::time::Duration;

use super::*;

const BOUNDS: Bounds = Bounds {
    chunks: 3,
    bytes: 100,
};

fn chunk(step: u32, bytes: usize) -> Chunk {
    Chunk {
        actor_id: "actor".into(),
        epoch: 0,
        seq: 0,
        episode_id: 1,
        first_step: step,
        steps: 1,
        ends_episode: false,
        payload: vec![0; bytes].into(),
    }
}

/// Whether the chunk found room at once.
async fn pushed(spool: &Spool, step: u32, bytes: usize) -> bool {
    tokio::time::timeout(Duration::ZERO, spool.push(chunk(step, bytes)))
        .await
        .is_ok()
}

fn sent(spool: &Spool, store: &str, seq: u64) -> Option<(u64, u32)> {
    let chunk = spool.get(store, seq, true)?;
    assert_eq!(Some(chunk.epoch), spool.epoch(store).or(Some(0)));
    Some((chunk.seq, chunk.first_step))
}

#[tokio::test]
async fn it_is_bounded_in_chunks_and_in_bytes_and_takes_one_chunk_of_any_size() {
    let spool = Spool::new(BOUNDS);
    for step in 0..3 {
        assert!(pushed(&spool, step, 1).await);
    }
    assert!(!pushed(&spool, 3, 1).await, "three chunks are all");
    let spool = Spool::new(BOUNDS);
    assert!(pushed(&spool, 0, 60).await);
    assert!(!pushed(&spool, 1, 41).await, "100 bytes are all");
    assert!(pushed(&spool, 1, 40).await);
    let spool = Spool::new(BOUNDS);
    assert!(pushed(&spool, 0, 1000).await, "or it would wait for ever");
    assert!(!pushed(&spool, 1, 1).await);
    assert!(sent(&spool, "a", 0).is_some());
    spool.turn_to("a");
    spool.acknowledge("a", 1).expect("sent");
    assert!(pushed(&spool, 1, 1).await);
}

#[tokio::test]
async fn what_one_store_was_sent_is_never_sent_to_another() {
    let spool = Spool::new(BOUNDS);
    for step in 0..3 {
        assert!(pushed(&spool, step, 1).await);
    }
    spool.turn_to("a");
    spool.begin("a", 7);
    assert_eq!(sent(&spool, "a", 0), Some((0, 0)));
    assert_eq!(sent(&spool, "a", 1), Some((1, 1)));
    assert_eq!((spool.epoch("a"), spool.epoch("b")), (Some(7), None));
    assert_eq!(spool.left_behind(), [""; 0], "the client is still there");
    assert_eq!(spool.turn_to("b"), 0);
    assert_eq!(spool.left_behind(), ["a"]);
    assert_eq!(sent(&spool, "b", 0), Some((0, 2)), "numbered by store");
    assert_eq!(sent(&spool, "b", 1), None);
    assert_eq!(sent(&spool, "a", 1), Some((1, 1)), "kept for its store");
    assert!(
        pushed(&spool, 3, 1).await,
        "a store that is away holds nobody up"
    );
    spool.acknowledge("a", 2).expect("sent");
    spool.acknowledge("b", 1).expect("sent");
    assert_eq!((spool.len(), spool.acknowledged()), (1, 3));
    assert!(!spool.is_left_behind("a"), "it has all");
    assert!(spool.acknowledge("b", 2).is_err(), "never sent");
}

#[tokio::test]
async fn turning_to_another_store_lets_a_waiting_producer_go_on() {
    let spool = Arc::new(Spool::new(BOUNDS));
    spool.turn_to("a");
    for step in 0..3 {
        assert!(pushed(&spool, step, 1).await);
        assert!(sent(&spool, "a", step.into()).is_some());
    }
    let waiting = spool.clone();
    let producer = tokio::spawn(async move { waiting.push(chunk(3, 1)).await });
    tokio::task::yield_now().await;
    assert!(!producer.is_finished());
    spool.turn_to("b");
    let woken = tokio::time::timeout(Duration::from_secs(10), producer).await;
    assert!(woken.expect("woken").expect("no panic"));
}

#[tokio::test]
async fn stores_that_stay_away_cost_a_bounded_number_of_chunks() {
    let spool = Spool::new(BOUNDS);
    let mut given_up = 0;
    for round in 0..10_u32 {
        let store = format!("store-{round}");
        given_up += spool.turn_to(&store);
        for step in 0..2 {
            assert!(pushed(&spool, step, 1).await);
            assert!(sent(&spool, &store, step.into()).is_some());
        }
    }
    assert_eq!(
        spool.len(),
        3 + 2,
        "the bound for those away, and the current store's"
    );
    assert_eq!((given_up, spool.given_up()), (20 - 5, 20 - 5));
}

#[tokio::test]
async fn what_the_store_that_was_left_first_has_not_is_given_up_first() {
    let spool = Spool::new(BOUNDS);
    // Ids are drawn at random: their order says nothing.
    for store in ["c", "a", "b"] {
        spool.turn_to(store);
        for step in 0..2 {
            assert!(pushed(&spool, step, 1).await);
            assert!(sent(&spool, store, step.into()).is_some());
        }
    }
    assert_eq!(spool.given_up(), 1, "three of four may wait");
    assert_eq!((spool.first_seq("c"), spool.first_seq("a")), (1, 0));
    // Back at the first and away again: now it is the one that was left last.
    spool.turn_to("c");
    assert_eq!(spool.given_up(), 2);
    assert_eq!((spool.first_seq("c"), spool.first_seq("a")), (1, 1));
    spool.turn_to("b");
    assert_eq!((spool.first_seq("c"), spool.first_seq("a")), (1, 1));
    assert_eq!(spool.left_behind(), ["a", "c"]);
}

/// Store and first step of what was acknowledged.
#[derive(Debug, Default)]
struct Told(Mutex<Vec<(String, u32)>>);

impl AcknowledgedChunks for Told {
    fn acknowledged(&self, store_id: &str, chunk: &Chunk) {
        let mut told = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        told.push((store_id.to_owned(), chunk.first_step));
    }
}

#[tokio::test]
async fn an_observer_is_told_of_each_chunk_once_and_by_the_store_that_has_it() {
    let spool = Spool::new(BOUNDS);
    let told = Arc::new(Told::default());
    spool.observe(told.clone());
    for step in 0..3 {
        assert!(pushed(&spool, step, 1).await);
    }
    for (store, seq) in [("a", 0), ("a", 1), ("b", 0)] {
        assert!(sent(&spool, store, seq).is_some());
    }
    for (store, durable) in [("b", 1), ("a", 1), ("a", 1), ("a", 2)] {
        spool.acknowledge(store, durable).expect("it was sent");
    }
    let expected = [("b", 2), ("a", 0), ("a", 1)].map(|(store, step)| (store.to_owned(), step));
    assert_eq!(*told.0.lock().expect("nobody panicked"), expected);
}
