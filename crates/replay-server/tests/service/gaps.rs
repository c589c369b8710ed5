//! After a gap of either side the replay ratio is caught up within the limiter's tolerance, never in one burst.

use std::collections::BTreeMap;
use std::time::Duration;

use isodream_replay::LimiterOptions;
use isodream_rpc::{AppendClient, SampleClient, SampleOptions};
use tokio::runtime::Runtime;

use crate::common::{DEADLINE, STEPS, Server, actor, chunk, sampling, until};

const LENGTH: u32 = 10;
const LIMITER: LimiterOptions = LimiterOptions {
    min_steps: 20,
    samples_per_insert: 2.0,
    tolerance_steps: 60.0,
};

/// Steps that may have been drawn at most when so many are inserted.
fn allowed(inserted: u64) -> u64 {
    let due = (inserted as f64 - LIMITER.min_steps as f64) * LIMITER.samples_per_insert;
    (due + LIMITER.tolerance_steps) as u64 + u64::from(LENGTH)
}

fn learner(server: &Server, sampled_steps: &BTreeMap<String, u64>) -> SampleClient {
    SampleClient::start(
        &isodream_rpc::Dialer::default(),
        SampleOptions {
            sampled_steps: sampled_steps.clone(),
            ..sampling(&server.address, LENGTH)
        },
    )
    .unwrap()
}

/// Takes sequences until the limiter makes the learner wait; returns what its checkpoint would keep.
async fn drain(learner: &mut SampleClient) -> BTreeMap<String, u64> {
    let mut counts = BTreeMap::new();
    loop {
        match tokio::time::timeout(Duration::from_millis(300), learner.next()).await {
            Ok(sequence) => {
                let sequence = sequence.unwrap();
                counts.insert(sequence.store_id.to_string(), sequence.sampled_steps);
            }
            Err(_) => {
                let behind = |why: &String| why.contains("actors are behind");
                until("the learner has to wait", || {
                    learner.waiting().filter(behind)
                })
                .await;
                return counts;
            }
        }
    }
}

/// [`drain`] while what the actor holds goes in, and then what that allows.
async fn drain_all(actor: &AppendClient, learner: &mut SampleClient) -> BTreeMap<String, u64> {
    let (mut counts, flushed) = tokio::join!(drain(learner), actor.flush(DEADLINE));
    flushed.unwrap();
    counts.extend(drain(learner).await);
    counts
}

/// Hands chunks over from `next` on until the limiter holds the actor.
async fn fill(actor: &AppendClient, next: &mut u64) {
    while let Ok(sent) =
        tokio::time::timeout(Duration::from_millis(300), actor.send(chunk(*next))).await
    {
        sent.unwrap();
        *next += 1;
        assert!(*next < 200, "the limiter never held the actor");
    }
    let why = actor.waiting().unwrap();
    assert!(why.contains("learner is behind"), "{why}");
}

#[test]
fn neither_side_catches_up_in_one_burst() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), LIMITER);
    Runtime::new().unwrap().block_on(async {
        let inserted = || crate::experience::inserted_steps(&server.address);
        let actor = actor(&server.address, 2);
        let mut next = 0;
        // No learner: inserts wait as soon as more than the tolerance is due.
        fill(&actor, &mut next).await;
        let due = (inserted().await as f64 - 20.0) * LIMITER.samples_per_insert;
        assert!(
            due <= LIMITER.tolerance_steps + 2.0 * f64::from(STEPS),
            "{due}"
        );

        // It comes: what was due and the tolerance, no more. What waited in the spool goes in meanwhile.
        let mut first = learner(&server, &BTreeMap::new());
        let used = drain_all(&actor, &mut first).await;
        let sampled: u64 = used.values().sum();
        assert_eq!(sampled, allowed(inserted().await), "held at its bound");

        // The actor was away while the learner waited: each chunk frees its own share alone.
        for _ in 0..3 {
            actor.send(chunk(next)).await.unwrap();
            next += 1;
        }
        actor.flush(DEADLINE).await.unwrap();
        let later = drain(&mut first).await;
        let sampled: u64 = later.values().sum();
        assert_eq!(sampled, allowed(inserted().await));

        // The learner dies and goes on from an older checkpoint: it draws again what that had not seen, and
        // inserts have waited for it.
        drop(first);
        let before = inserted().await;
        let mut second = learner(&server, &used);
        let again = drain(&mut second).await;
        assert_eq!(again, later);
        assert_eq!(inserted().await, before);

        // Away for long with its count at the bound: the surplus that builds up ends at the tolerance.
        drop(second);
        fill(&actor, &mut next).await;
        let grown = inserted().await - before;
        let most = (2.0 * LIMITER.tolerance_steps + f64::from(LENGTH)) / LIMITER.samples_per_insert;
        assert!(
            grown as f64 <= most + f64::from(STEPS),
            "{grown} steps in one gap"
        );
        let mut third = learner(&server, &again);
        let caught_up = drain_all(&actor, &mut third).await;
        let sampled: u64 = caught_up.values().sum();
        assert_eq!(sampled, allowed(inserted().await));
    });
    server.stop().unwrap();
}
