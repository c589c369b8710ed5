use isodream_proto::Identity;

use super::*;
use crate::Dialer;

const PREFETCH: usize = 40;
/// Batches of priorities that wait for a server.
const PRIORITIES: usize = 3;

struct Bench {
    merge: SampleMerge,
    sequences: mpsc::Receiver<SampledSequence>,
    requests: BTreeMap<&'static str, mpsc::Receiver<SampleRequest>>,
}

impl Bench {
    fn new(unlimited_sequences: u64) -> Self {
        let options = SampleOptions {
            addresses: vec!["a:1".into(), "b:1".into()],
            identity: Identity {
                env_spec_hash: "hash".into(),
                env_spec: "spec".into(),
                model_hash: String::new(),
            },
            sequence_length: 5,
            table: "train".into(),
            learner_epoch: 0,
            seed: 1,
            prefetch: PREFETCH,
            sampled_steps: BTreeMap::from([("store-a".to_owned(), 100)]),
            unlimited_sequences,
        };
        let (sender, sequences) = mpsc::channel(PREFETCH);
        let (_, priorities) = mpsc::channel(1);
        let watch = SampleWatch::default();
        Self {
            merge: SampleMerge::new(Dialer::default(), options, sender, priorities, watch),
            sequences,
            requests: BTreeMap::new(),
        }
    }

    /// Whether the merge wants the server; its hello is returned as well.
    fn found(&mut self, name: &'static str, store: &str, steps: u64) -> Option<SampleHello> {
        let (requests, mut received) = mpsc::channel(PREFETCH + 1 + PRIORITIES);
        let status = ReplayStatus {
            steps,
            inserted_steps: 2 * steps,
            store_id: store.to_owned(),
            ..ReplayStatus::default()
        };
        let wanted = self.merge.found(name.to_owned(), status.clone(), requests);
        let Ok(SampleRequest {
            kind: Some(Kind::Hello(hello)),
        }) = received.try_recv()
        else {
            assert!(!wanted);
            return None;
        };
        self.requests.insert(name, received);
        self.merge.happened(name.to_owned(), Event::Holds(status));
        wanted.then_some(hello)
    }

    /// Credits that came to a server since the last call: limited, unlimited.
    fn credits(&mut self, name: &str) -> (u32, u32) {
        self.merge.grant();
        let mut sum = (0, 0);
        let received = self.requests.get_mut(name).expect("found before");
        while let Ok(request) = received.try_recv() {
            match request.kind {
                Some(Kind::Credit(credit)) if credit.unlimited => sum.1 += credit.sequences,
                Some(Kind::Credit(credit)) => sum.0 += credit.sequences,
                other => panic!("{other:?}"),
            }
        }
        sum
    }

    fn serve(&mut self, name: &str) {
        let chunk = isodream_proto::v1::Chunk {
            steps: 5,
            ..Default::default()
        };
        let reply = SampleReply {
            chunks: vec![chunk],
            ..SampleReply::default()
        };
        self.merge.replied(name, reply).expect("asked for");
    }

    fn wait(&mut self, name: &str, returned_credits: u32) {
        let reply = SampleReply {
            waiting: "the actors are behind".into(),
            returned_credits,
            ..SampleReply::default()
        };
        self.merge.replied(name, reply).expect("no sequence");
    }
}

#[tokio::test]
async fn draws_go_to_the_servers_in_proportion_to_what_they_hold() {
    let mut bench = Bench::new(0);
    bench.found("a", "store-a", 3_000).expect("wanted");
    bench.found("b", "store-b", 1_000).expect("wanted");
    let mut asked = BTreeMap::from([("a", 0_u32), ("b", 0)]);
    for _ in 0..200 {
        for name in ["a", "b"] {
            let (credits, _) = bench.credits(name);
            *asked.get_mut(name).expect("listed") += credits;
            for _ in 0..credits {
                bench.serve(name);
                bench.sequences.try_recv().expect("served");
            }
        }
    }
    let share = f64::from(asked["a"]) / f64::from(asked["a"] + asked["b"]);
    assert!(asked["a"] + asked["b"] > 4000, "{asked:?}");
    // Four standard deviations of 4000 draws.
    assert!((share - 0.75).abs() < 0.028, "{asked:?}");
    assert_eq!(bench.merge.watch.inserted_steps(), 8_000);
}

#[tokio::test]
async fn a_waiting_server_keeps_one_credit_and_the_others_are_spent_elsewhere() {
    let mut bench = Bench::new(0);
    bench.found("a", "store-a", 1_000).expect("wanted");
    bench.found("b", "store-b", 1_000).expect("wanted");
    let (at_a, at_b) = (bench.credits("a").0, bench.credits("b").0);
    assert_eq!(at_a + at_b, PREFETCH as u32);
    bench.wait("a", at_a - 1);
    assert_eq!(bench.credits("b").0, at_a - 1);
    assert_eq!(bench.credits("a").0, 0);
    bench.wait("b", at_a + at_b - 2);
    assert_eq!(bench.credits("a").0 + bench.credits("b").0, 0, "all wait");
    bench.serve("a");
    assert_eq!(
        bench.credits("a").0,
        PREFETCH as u32 - 2,
        "one is taken, one is at b"
    );
}

#[tokio::test]
async fn every_store_has_its_count_and_only_limited_draws_count() {
    let mut bench = Bench::new(1);
    let hello = bench.found("a", "store-a", 1).expect("wanted");
    assert_eq!(
        (hello.sampled_steps, hello.store_id.as_str()),
        (100, "store-a")
    );
    assert_eq!(bench.credits("a"), (PREFETCH as u32 - 1, 1));
    let mut counts = Vec::new();
    for _ in 0..3 {
        bench.serve("a");
        counts.push(bench.sequences.try_recv().expect("served").sampled_steps);
    }
    assert_eq!(counts, [100, 105, 110]);
    bench.merge.happened("a".into(), Event::Lost);
    let hello = bench.found("b", "store-b", 1).expect("wanted");
    assert_eq!(hello.sampled_steps, 0);
    assert_eq!(
        bench.credits("b"),
        (PREFETCH as u32, 0),
        "what was lost is asked again"
    );
    bench.serve("b");
    let sequence = bench.sequences.try_recv().expect("served");
    assert_eq!(
        (&*sequence.store_id, sequence.sampled_steps),
        ("store-b", 5)
    );
    let hello = bench.found("a", "store-a", 1).expect("wanted");
    assert_eq!(hello.sampled_steps, 110, "kept while it was away");
}

#[tokio::test]
async fn a_store_at_two_addresses_is_drawn_from_once() {
    let mut bench = Bench::new(0);
    assert!(bench.found("a", "store-a", 1).is_some());
    assert!(bench.found("b", "store-a", 1).is_none());
}

#[tokio::test]
async fn a_server_that_sends_unasked_is_dropped() {
    let mut bench = Bench::new(0);
    bench.found("a", "store-a", 1).expect("wanted");
    let reply = SampleReply {
        chunks: vec![isodream_proto::v1::Chunk::default()],
        ..SampleReply::default()
    };
    bench.merge.happened("a".into(), Event::Reply(reply));
    assert!(bench.merge.servers.is_empty());
    assert!(bench.sequences.try_recv().is_err());
}

#[tokio::test]
async fn a_server_that_gives_back_more_than_it_has_is_dropped() {
    let mut bench = Bench::new(0);
    bench.found("a", "store-a", 1).expect("wanted");
    let (granted, _) = bench.credits("a");
    let reply = SampleReply {
        waiting: "the actors are behind".into(),
        returned_credits: granted + 1,
        ..SampleReply::default()
    };
    bench.merge.happened("a".into(), Event::Reply(reply));
    assert!(bench.merge.servers.is_empty());
}

#[tokio::test]
async fn priorities_go_to_the_store_they_came_from_and_leave_room_for_credits() {
    let mut bench = Bench::new(0);
    bench.found("a", "store-a", 1_000).expect("wanted");
    bench.found("b", "store-b", 1_000).expect("wanted");
    let update = |store: &str, episode_id| PriorityUpdate {
        store_id: store.into(),
        episode_id,
        start_step: 3,
        priority: 0.5,
    };
    for episode in 0..9 {
        let updates = vec![update("store-a", episode), update("store-gone", 1)];
        bench.merge.send_priorities(&updates);
    }
    let received = bench.requests.get_mut("a").expect("found before");
    for episode in 0..PRIORITIES as u64 {
        let request = received.try_recv().expect("a batch");
        let Some(Kind::Priorities(batch)) = request.kind else {
            panic!("{request:?}");
        };
        assert_eq!(batch.episode_ids, [episode]);
        assert_eq!((batch.start_steps, batch.priorities), (vec![3], vec![0.5]));
    }
    // The other server got none, and no credit was lost.
    let (a, b) = (bench.credits("a"), bench.credits("b"));
    assert_eq!(a.0 + b.0, PREFETCH as u32);
}

#[tokio::test]
async fn an_address_that_is_given_up_is_looked_at_no_more_unless_a_server_is_there() {
    let mut bench = Bench::new(0);
    let (events, _reports) = mpsc::channel(EVENTS);
    let mut tasks = JoinSet::new();
    let mut looked_up = |bench: &mut Bench, names: &[&str]| {
        let addresses = names.iter().map(|name| (*name).to_owned()).collect();
        bench.merge.link_to(addresses, &events, &mut tasks);
        bench.merge.links.keys().cloned().collect::<Vec<_>>()
    };
    assert_eq!(looked_up(&mut bench, &["a:1", "b:1"]), ["a:1", "b:1"]);
    bench.found("b:1", "store-b", 1).expect("wanted");
    assert_eq!(looked_up(&mut bench, &["c:1"]), ["b:1", "c:1"]);
    let waiting = bench.merge.watch.waiting().expect("nobody answers");
    assert!(
        !waiting.contains("a:1") && waiting.contains("c:1"),
        "{waiting}"
    );
    bench.merge.happened("b:1".into(), Event::Lost);
    assert_eq!(looked_up(&mut bench, &["c:1"]), ["c:1"]);
}
