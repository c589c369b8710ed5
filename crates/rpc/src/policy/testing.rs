//! Doors and followers on loopback.

#![allow(clippy::unwrap_used)]

use std::sync::{Arc, Mutex};
use std::time::Duration;

use isodream_core::{EnvSpec, ImageShape};
use isodream_proto::{Identity, v1};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Status;

use super::follow::{KeepPolicies, follow_policy};
use super::publisher::{Policy, PolicyPublisher, PolicyWatch};
use super::service::{PolicyDesk, policy_service};
use crate::{Dialer, Door, bind, serve, server};

/// Longer than anything here takes on a busy machine.
pub(super) const DEADLINE: Duration = Duration::from_secs(30);

pub(super) fn identity(env: &str, model_hash: &str) -> Identity {
    let spec = EnvSpec {
        id: env.to_owned(),
        image: ImageShape {
            height: 2,
            width: 2,
            channels: 3,
        },
        action_dim: 2,
        action_repeat: 1,
        time_limit: 100,
    };
    Identity::new(&spec, model_hash)
}

/// Version `version` of the learner that started at `epoch`: some parts, the last one not full.
pub(super) fn policy(epoch: u64, version: u64) -> Policy {
    let weights: Vec<u8> = (0..2_500_000_u64)
        .map(|i| (i * 31 + 7 * version + epoch) as u8)
        .collect();
    Policy::new(
        v1::PolicyVersion {
            learner_epoch: epoch,
            version,
        },
        weights,
    )
}

/// The desk of a learner that keeps what it is told.
#[derive(Debug, Clone)]
pub(super) struct Desk {
    pub(super) identity: Identity,
    pub(super) publisher: PolicyPublisher,
    pub(super) reports: Arc<Mutex<Vec<v1::EpisodeReport>>>,
    /// Who asked to follow the policy.
    pub(super) visitors: Arc<Mutex<Vec<String>>>,
}

impl Desk {
    pub(super) fn new(identity: Identity) -> Self {
        Self {
            identity,
            publisher: PolicyPublisher::default(),
            reports: Arc::default(),
            visitors: Arc::default(),
        }
    }
}

#[tonic::async_trait]
impl PolicyDesk for Desk {
    fn publisher(&self) -> &PolicyPublisher {
        &self.publisher
    }

    async fn admit(&self, request: &v1::WatchPolicyRequest) -> Result<PolicyWatch, Status> {
        let visitor = request.actor_id.clone();
        self.visitors.lock().unwrap().push(visitor);
        self.publisher.watch_for(&self.identity, request)
    }

    async fn report(&self, report: v1::EpisodeReport) -> Result<(), Status> {
        self.reports.lock().unwrap().push(report);
        Ok(())
    }

    async fn status(&self) -> Result<v1::LearnerStatus, Status> {
        Ok(v1::LearnerStatus {
            phase: "training".to_owned(),
            ..v1::LearnerStatus::default()
        })
    }
}

/// A served desk.
pub(super) struct Served {
    pub(super) address: String,
    pub(super) shutdown: CancellationToken,
    running: JoinHandle<Result<(), crate::RpcError>>,
}

impl Served {
    pub(super) async fn open(desk: impl PolicyDesk) -> Self {
        Self::open_at("127.0.0.1:0", desk).await
    }

    /// Opens a door where another one was closed.
    pub(super) async fn open_at(address: &str, desk: impl PolicyDesk) -> Self {
        let listener = listener(address).await;
        let address = listener.local_addr().unwrap().to_string();
        let shutdown = CancellationToken::new();
        let router = server(&Door::default())
            .unwrap()
            .add_service(policy_service(desk, shutdown.clone()));
        let running = tokio::spawn(serve(router, listener, shutdown.clone()));
        Self {
            address,
            shutdown,
            running,
        }
    }

    /// Stops as a signal would.
    pub(super) async fn close(self) {
        self.shutdown.cancel();
        let ended = tokio::time::timeout(DEADLINE, self.running).await;
        ended.unwrap().unwrap().unwrap();
    }
}

async fn listener(address: &str) -> TcpListener {
    let begun = tokio::time::Instant::now();
    loop {
        match bind(address, &Door::default()).await {
            Ok(listener) => return listener,
            Err(error) => assert!(begun.elapsed() < DEADLINE, "{error}"),
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

/// Someone who follows the policy; ended on drop.
pub(super) struct Actor {
    taken: tokio::sync::mpsc::UnboundedReceiver<Policy>,
    following: JoinHandle<Status>,
}

impl Actor {
    pub(super) fn start(address: &str, identity: &Identity) -> Self {
        let request = v1::WatchPolicyRequest {
            handshake: Some(identity.handshake()),
            actor_id: "actor-0".to_owned(),
        };
        let client = Dialer::default().learner(address).unwrap();
        let (sender, taken) = tokio::sync::mpsc::unbounded_channel();
        let sink = KeepPolicies::new(move |policy| {
            let _ = sender.send(policy);
        });
        let following = tokio::spawn(follow_policy(client, request, sink));
        Self { taken, following }
    }

    /// The next policy that arrives.
    pub(super) async fn next(&mut self) -> Policy {
        let next = tokio::time::timeout(DEADLINE, self.taken.recv()).await;
        next.expect("a policy arrives").expect("it follows")
    }

    /// Whether anything arrived.
    pub(super) fn has_none(&mut self) -> bool {
        self.taken.try_recv().is_err() && !self.following.is_finished()
    }

    /// Waits until it is refused for good.
    pub(super) async fn refused(mut self) -> Status {
        let refusal = tokio::time::timeout(DEADLINE, &mut self.following).await;
        refusal.expect("it is refused").unwrap()
    }
}

impl Drop for Actor {
    fn drop(&mut self) {
        self.following.abort();
    }
}
