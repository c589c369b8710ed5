//! A replay-server that hands on the learner's policies.

use isodream_proto::v1;
use isodream_replay_server::{PolicySource, ServerOptions, serve};
use isodream_rpc::{
    Dialer, Door, KeepPolicies, Policy, PolicyDesk, PolicyPublisher, PolicyWatch, follow_policy,
    policy_service,
};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status};

use crate::common::{DEADLINE, NO_LIMIT, appending, chunk, identity};

/// A learner that does nothing but publish, and keeps the names of those who come.
struct Desk {
    publisher: PolicyPublisher,
    visitors: mpsc::UnboundedSender<String>,
}

#[tonic::async_trait]
impl PolicyDesk for Desk {
    fn publisher(&self) -> &PolicyPublisher {
        &self.publisher
    }

    async fn admit(&self, request: &v1::WatchPolicyRequest) -> Result<PolicyWatch, Status> {
        self.visitors.send(request.actor_id.clone()).unwrap();
        Ok(self.publisher.watch())
    }

    async fn report(&self, _: v1::EpisodeReport) -> Result<(), Status> {
        Ok(())
    }

    async fn status(&self) -> Result<v1::LearnerStatus, Status> {
        Ok(v1::LearnerStatus::default())
    }
}

fn request(actor_id: &str) -> v1::WatchPolicyRequest {
    v1::WatchPolicyRequest {
        handshake: Some(identity("highway/day").handshake()),
        actor_id: actor_id.to_owned(),
    }
}

#[tokio::test]
async fn one_address_takes_experience_and_hands_on_policies() {
    let publisher = PolicyPublisher::default();
    let (visitors, mut visited) = mpsc::unbounded_channel();
    let desk = Desk {
        publisher: publisher.clone(),
        visitors,
    };
    let shutdown = CancellationToken::new();
    let listener = isodream_rpc::bind("127.0.0.1:0", &Door::default())
        .await
        .unwrap();
    let learner = listener.local_addr().unwrap().to_string();
    let router = isodream_rpc::server(&Door::default())
        .unwrap()
        .add_service(policy_service(desk, shutdown.clone()));
    tokio::spawn(isodream_rpc::serve(router, listener, shutdown.clone()));

    let folder = tempfile::tempdir().unwrap();
    let options = |relay_policy| ServerOptions {
        folder: folder.path().to_owned(),
        store: isodream_replay::StoreOptions::default(),
        limiter: NO_LIMIT,
        relay_policy,
        tables: Vec::new(),
        door: Door::default(),
    };
    let listener = isodream_rpc::bind("127.0.0.1:0", &Door::default())
        .await
        .unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let replay_shutdown = CancellationToken::new();
    let running = tokio::spawn(serve(
        options(Some(PolicySource {
            address: learner,
            dialer: Dialer::default(),
        })),
        listener,
        replay_shutdown.clone(),
    ));

    let append =
        isodream_rpc::AppendClient::start(&Dialer::default(), appending(&address, 4)).unwrap();
    append.send(chunk(0)).await.unwrap();
    append.flush(DEADLINE).await.unwrap();
    let (taken, mut policies) = mpsc::unbounded_channel();
    let sink = KeepPolicies::new(move |policy| taken.send(policy).unwrap());
    let client = Dialer::default().learner(&address).unwrap();
    let follower = tokio::spawn(follow_policy(client, request("actor-0"), sink));
    let version = v1::PolicyVersion {
        learner_epoch: 3,
        version: 20,
    };
    let published = Policy::new(version, vec![7; 100_000]);
    publisher.publish(published.clone());
    let policy = tokio::time::timeout(DEADLINE, policies.recv()).await;
    assert_eq!(policy.unwrap(), Some(published));
    assert_eq!(visited.recv().await.unwrap(), "actor-0");
    let relay = visited.recv().await.unwrap();
    assert!(relay.starts_with("relay "), "{relay}");

    // Open watches do not hold the shutdown up.
    let begun = std::time::Instant::now();
    replay_shutdown.cancel();
    running.await.unwrap().unwrap();
    assert!(begun.elapsed() < isodream_rpc::limits::SHUTDOWN_GRACE);
    follower.abort();

    // Without the option there is no such door.
    let listener = isodream_rpc::bind("127.0.0.1:0", &Door::default())
        .await
        .unwrap();
    let address = listener.local_addr().unwrap().to_string();
    tokio::spawn(serve(options(None), listener, shutdown.clone()));
    let client = Dialer::default().learner(&address).unwrap();
    let sink = KeepPolicies::new(|_| {});
    let refusal = follow_policy(client, request("actor-0"), sink);
    let refusal = tokio::time::timeout(DEADLINE, refusal).await.unwrap();
    assert_eq!(refusal.code(), Code::Unimplemented);
    shutdown.cancel();
}
