//! Relays between a learner and its actors.

#![allow(clippy::unwrap_used)]

use std::time::Duration;

use isodream_proto::v1;
use tokio_util::sync::CancellationToken;
use tonic::Code;

use super::relay::PolicyRelay;
use super::service::PolicyDesk;
use super::testing::{Actor, Desk, Served, identity, policy};
use crate::{Dialer, Door};

async fn relay(upstream: &str) -> Served {
    let relay = PolicyRelay::new(
        &Dialer::default(),
        upstream,
        "relay",
        CancellationToken::new(),
    )
    .unwrap();
    Served::open(relay).await
}

#[tokio::test]
async fn a_chain_of_relays_hands_on_bit_for_bit_and_asks_the_learner_once() {
    let desk = Desk::new(identity("highway/day", "m"));
    let learner = Served::open(desk.clone()).await;
    let first = relay(&learner.address).await;
    let second = relay(&first.address).await;
    let mut actors: Vec<Actor> = (0..10)
        .map(|_| Actor::start(&second.address, &desk.identity))
        .collect();
    for version in [1, 2] {
        desk.publisher.publish(policy(5, version));
        for actor in &mut actors {
            assert_eq!(actor.next().await, policy(5, version));
        }
    }
    // One actor was asked for, then each relay follows in its own name; the second's is asked for by the first
    // only if its handshake is new.
    let visitors = desk.visitors.lock().unwrap().clone();
    assert_eq!(visitors, ["actor-0", "relay"]);
}

#[tokio::test]
async fn reports_and_questions_reach_the_learner() {
    let desk = Desk::new(identity("highway/day", "m"));
    let learner = Served::open(desk.clone()).await;
    let relay = relay(&learner.address).await;
    let report = v1::EpisodeReport {
        actor_id: "actor-7".to_owned(),
        score: 12.5,
        metrics: [("distance_m".to_owned(), 3.0)].into(),
        ..v1::EpisodeReport::default()
    };
    let mut client = Dialer::default().learner(&relay.address).unwrap();
    client.report_episode(report.clone()).await.unwrap();
    assert_eq!(
        desk.reports.lock().unwrap().as_slice(),
        std::slice::from_ref(&report)
    );
    let status = client.status(v1::LearnerStatusRequest {}).await.unwrap();
    assert_eq!(status.into_inner().phase, "training");

    let address = learner.address.clone();
    learner.close().await;
    let away = client.report_episode(report).await.unwrap_err();
    assert_eq!(away.code(), Code::Unavailable, "{away}");
    assert!(away.message().contains(&address), "{away}");
}

#[tokio::test]
async fn an_actor_of_another_environment_is_refused_in_the_learners_words() {
    let desk = Desk::new(identity("highway/day", "m"));
    let learner = Served::open(desk.clone()).await;
    let relay = relay(&learner.address).await;
    let stranger = identity("dmc/walker_walk", "m");
    let refusal = Actor::start(&relay.address, &stranger).refused().await;
    assert_eq!(refusal.code(), Code::FailedPrecondition);
    for words in ["environment", "dmc/walker_walk", "same [env] configuration"] {
        assert!(refusal.message().contains(words), "{refusal}");
    }
    // It is no reason to turn others away.
    desk.publisher.publish(policy(5, 1));
    let mut actor = Actor::start(&relay.address, &desk.identity);
    assert_eq!(actor.next().await, policy(5, 1));
    let refusal = Actor::start(&relay.address, &stranger).refused().await;
    assert_eq!(refusal.code(), Code::FailedPrecondition);
}

#[tokio::test]
async fn the_learners_absence_and_return_are_survived() {
    let identity = identity("highway/day", "m");
    let desk = Desk::new(identity.clone());
    let learner = Served::open(desk.clone()).await;
    let address = learner.address.clone();
    let relay = relay(&address).await;
    let mut early = Actor::start(&relay.address, &identity);
    desk.publisher.publish(policy(5, 9));
    assert_eq!(early.next().await, policy(5, 9));
    learner.close().await;

    // What the relay has, it serves meanwhile.
    let mut late = Actor::start(&relay.address, &identity);
    assert_eq!(late.next().await, policy(5, 9));

    // The learner returns from a checkpoint: a greater epoch, a smaller version.
    let desk = Desk::new(identity.clone());
    let _learner = Served::open_at(&address, desk.clone()).await;
    desk.publisher.publish(policy(6, 4));
    assert_eq!(early.next().await, policy(6, 4));
    assert_eq!(late.next().await, policy(6, 4));
}

#[tokio::test]
async fn an_actor_that_comes_while_the_learner_is_away_is_let_in_later() {
    let identity = identity("highway/day", "m");
    let address = {
        let gone = Served::open(Desk::new(identity.clone())).await;
        let address = gone.address.clone();
        gone.close().await;
        address
    };
    let relay = relay(&address).await;
    let mut actor = Actor::start(&relay.address, &identity);
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert!(actor.has_none());
    let desk = Desk::new(identity);
    desk.publisher.publish(policy(5, 1));
    let _learner = Served::open_at(&address, desk).await;
    assert_eq!(actor.next().await, policy(5, 1));
}

#[tokio::test]
async fn when_another_run_takes_the_learners_place_no_actor_gets_its_policies_by_mistake() {
    let (ours, theirs) = (identity("highway/day", "a"), identity("highway/day", "b"));
    let desk = Desk::new(ours.clone());
    let learner = Served::open(desk.clone()).await;
    let address = learner.address.clone();
    let relay = relay(&address).await;
    let mut actor = Actor::start(&relay.address, &ours);
    desk.publisher.publish(policy(5, 1));
    assert_eq!(actor.next().await, policy(5, 1));
    learner.close().await;

    let other = Desk::new(theirs.clone());
    other.publisher.publish(policy(7, 1));
    let _learner = Served::open_at(&address, other).await;
    let mut newcomer = Actor::start(&relay.address, &theirs);
    assert_eq!(newcomer.next().await, policy(7, 1));
    let refusal = actor.refused().await;
    assert_eq!(refusal.code(), Code::FailedPrecondition);
    assert!(refusal.message().contains("model hash a"), "{refusal}");
}

#[tokio::test]
async fn a_learner_that_does_not_speak_the_protocol_is_the_relays_trouble() {
    // A server without the service: the relay's address is wrong, the actor's is not.
    let relay_of_nothing = {
        let (_, health) = tonic_health::server::health_reporter();
        let listener = crate::bind("127.0.0.1:0", &Door::default()).await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let router = crate::server(&Door::default()).unwrap().add_service(health);
        tokio::spawn(crate::serve(router, listener, CancellationToken::new()));
        PolicyRelay::new(
            &Dialer::default(),
            &address,
            "relay",
            CancellationToken::new(),
        )
        .unwrap()
    };
    let request = v1::WatchPolicyRequest {
        handshake: Some(identity("highway/day", "m").handshake()),
        actor_id: "actor-0".to_owned(),
    };
    let status = relay_of_nothing.admit(&request).await.unwrap_err();
    assert_eq!(status.code(), Code::Unavailable, "{status}");
}
