//! A learner's door and those who follow it.

#![allow(clippy::unwrap_used)]

use std::time::Duration;

use isodream_proto::v1;
use tonic::Code;

use super::testing::{Actor, DEADLINE, Desk, Served, identity, policy};
use crate::Dialer;

#[tokio::test]
async fn policies_arrive_as_published_and_newer_ones_replace_them() {
    let desk = Desk::new(identity("highway/day", "m"));
    let publisher = desk.publisher.clone();
    let door = Served::open(desk.clone()).await;
    let mut actor = Actor::start(&door.address, &desk.identity);
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert!(actor.has_none(), "nothing is published yet");
    for version in [1, 2] {
        publisher.publish(policy(5, version));
        assert_eq!(actor.next().await, policy(5, version));
    }
    let mut late = Actor::start(&door.address, &desk.identity);
    assert_eq!(late.next().await, policy(5, 2));

    let mut client = Dialer::default().learner(&door.address).unwrap();
    let old = v1::FetchPolicyRequest {
        version: Some(policy(5, 1).version()),
    };
    let status = client.fetch_policy(old).await.err().unwrap();
    assert_eq!(status.code(), Code::NotFound);
    assert!(status.message().contains("fetch the newest"), "{status}");

    // Watches are open, and do not hold the shutdown up.
    let begun = std::time::Instant::now();
    door.close().await;
    assert!(begun.elapsed() < crate::limits::SHUTDOWN_GRACE);
}

#[tokio::test]
async fn an_actor_of_another_model_is_refused_by_name() {
    let desk = Desk::new(identity("highway/day", "ours"));
    let door = Served::open(desk).await;
    let actor = Actor::start(&door.address, &identity("highway/day", "theirs"));
    let refusal = actor.refused().await;
    assert_eq!(refusal.code(), Code::FailedPrecondition);
    assert!(refusal.message().contains("model hash theirs"), "{refusal}");
}

/// A learner that announces one thing and sends another.
#[tokio::test]
async fn damaged_weights_are_not_taken() {
    let desk = Desk::new(identity("highway/day", ""));
    let publisher = desk.publisher.clone();
    let honest = policy(5, 1);
    let damaged = super::publisher::Policy::verified(
        honest.version(),
        policy(5, 2).weights().to_vec(),
        honest.announcement().content_hash,
    );
    publisher.publish(damaged);
    let door = Served::open(desk.clone()).await;
    let mut actor = Actor::start(&door.address, &desk.identity);
    // It asks again and again.
    let begun = std::time::Instant::now();
    while desk.visitors.lock().unwrap().len() < 3 {
        assert!(begun.elapsed() < DEADLINE);
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert!(actor.has_none());
    publisher.publish(policy(5, 3));
    assert_eq!(actor.next().await, policy(5, 3));
}
