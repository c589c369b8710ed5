//! The learner's door as a process of the load generator: it publishes random weights when it is told to.

use anyhow::Context;
use bytes::Bytes;
use clap::Args;
use isodream_proto::{Identity, v1};
use isodream_rpc::{Door, Policy, PolicyDesk, PolicyPublisher, PolicyWatch, policy_service};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::bench::replay::part::answer;

/// The learner's epoch that the door stands for.
pub(super) const EPOCH: u64 = 1;

/// What the door has to know.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct DoorWork {
    /// `Identity`
    pub(super) env_spec_hash: String,
    pub(super) env_spec: String,
    pub(super) model_hash: String,
    /// Of a policy.
    pub(super) bytes: usize,
}

/// Options of the hidden command.
#[derive(Debug, Args)]
pub(crate) struct DoorArgs {
    /// `DoorWork` as JSON
    #[arg(long)]
    work: String,
}

struct Desk {
    identity: Identity,
    publisher: PolicyPublisher,
}

#[tonic::async_trait]
impl PolicyDesk for Desk {
    fn publisher(&self) -> &PolicyPublisher {
        &self.publisher
    }

    async fn admit(&self, request: &v1::WatchPolicyRequest) -> Result<PolicyWatch, Status> {
        self.publisher.watch_for(&self.identity, request)
    }

    async fn report(&self, _: v1::EpisodeReport) -> Result<(), Status> {
        Ok(())
    }

    async fn status(&self) -> Result<v1::LearnerStatus, Status> {
        Ok(v1::LearnerStatus::default())
    }
}

/// Runs the hidden command: prints where it listens, then publishes the version that each line of input names.
pub(crate) fn run(args: &DoorArgs) -> anyhow::Result<()> {
    let work: DoorWork = serde_json::from_str(&args.work).context("--work")?;
    let runtime = tokio::runtime::Runtime::new()?;
    let publisher = PolicyPublisher::default();
    let desk = Desk {
        identity: Identity {
            env_spec_hash: work.env_spec_hash,
            env_spec: work.env_spec,
            model_hash: work.model_hash,
        },
        publisher: publisher.clone(),
    };
    let shutdown = CancellationToken::new();
    let listener = runtime.block_on(isodream_rpc::bind("127.0.0.1:0", &Door::default()))?;
    let address = listener.local_addr()?.to_string();
    let router =
        isodream_rpc::server(&Door::default())?.add_service(policy_service(desk, shutdown.clone()));
    let serving = runtime.spawn(isodream_rpc::serve(router, listener, shutdown.clone()));
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut weights: Vec<u8> = (0..work.bytes).map(|_| rng.random()).collect();
    answer(&address, |version| {
        let version: u64 = version.parse()?;
        // Other bytes for every version, so that none can be taken for another.
        if let Some(first) = weights.first_mut() {
            *first = version as u8;
        }
        let version = v1::PolicyVersion {
            learner_epoch: EPOCH,
            version,
        };
        publisher.publish(Policy::new(version, Bytes::copy_from_slice(&weights)));
        Ok(())
    })?;
    shutdown.cancel();
    runtime
        .block_on(serving)
        .context("the task of the door died")??;
    Ok(())
}
