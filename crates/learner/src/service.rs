//! What stands behind the learner's gRPC door.

use std::sync::Arc;

use isodream_proto::{Identity, v1};
use isodream_rpc::{PolicyDesk, PolicyPublisher, PolicyWatch};
use tonic::Status;

use crate::progress::Progress;

pub(crate) struct Desk {
    pub(crate) identity: Identity,
    pub(crate) publisher: PolicyPublisher,
    pub(crate) progress: Arc<Progress>,
}

#[tonic::async_trait]
impl PolicyDesk for Desk {
    fn publisher(&self) -> &PolicyPublisher {
        &self.publisher
    }

    async fn admit(&self, request: &v1::WatchPolicyRequest) -> Result<PolicyWatch, Status> {
        self.publisher.watch_for(&self.identity, request)
    }

    async fn report(&self, report: v1::EpisodeReport) -> Result<(), Status> {
        self.progress.report(report);
        Ok(())
    }

    async fn status(&self) -> Result<v1::LearnerStatus, Status> {
        Ok(self.progress.status())
    }
}
