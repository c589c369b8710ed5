//! The learner's gRPC door, whoever stands behind it.

use std::pin::Pin;

use bytes::Bytes;
use isodream_proto::v1;
use isodream_proto::v1::learner_service_server::{LearnerService, LearnerServiceServer};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status};

use super::publisher::{PolicyPublisher, PolicyWatch};
use crate::ServiceError;
use crate::limits::MAX_MESSAGE_BYTES;

/// Bytes of weights per message.
const PART_BYTES: usize = 1 << 20;

/// What stands behind a door that hands out policies: which ones, to whom, and where reports go.
#[tonic::async_trait]
pub trait PolicyDesk: Send + Sync + 'static {
    /// Where the policies come from.
    fn publisher(&self) -> &PolicyPublisher;

    /// Lets someone watch the policies, or says why not.
    async fn admit(&self, request: &v1::WatchPolicyRequest) -> Result<PolicyWatch, Status>;

    /// Takes in an episode's report.
    async fn report(&self, report: v1::EpisodeReport) -> Result<(), Status>;

    /// How the run is doing.
    async fn status(&self) -> Result<v1::LearnerStatus, Status>;
}

/// `LearnerService` over a desk.
#[derive(Debug)]
pub struct PolicyService<D> {
    desk: D,
    shutdown: CancellationToken,
}

/// The service with this project's limits; `shutdown` ends its watches.
pub fn policy_service<D: PolicyDesk>(
    desk: D,
    shutdown: CancellationToken,
) -> LearnerServiceServer<PolicyService<D>> {
    LearnerServiceServer::new(PolicyService { desk, shutdown })
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES)
}

type Reply<T> = Result<Response<T>, Status>;
type Streamed<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

#[tonic::async_trait]
impl<D: PolicyDesk> LearnerService for PolicyService<D> {
    type WatchPolicyStream = ReceiverStream<Result<v1::PolicyAnnouncement, Status>>;
    type FetchPolicyStream = Streamed<v1::PolicyPart>;

    async fn watch_policy(
        &self,
        request: Request<v1::WatchPolicyRequest>,
    ) -> Reply<Self::WatchPolicyStream> {
        let request = request.into_inner();
        let watch = self.desk.admit(&request).await?;
        tracing::info!(actor = request.actor_id, "an actor follows the policy");
        let (sender, announcements) = mpsc::channel(1);
        tokio::spawn(announce(watch, sender, self.shutdown.clone()));
        Ok(Response::new(ReceiverStream::new(announcements)))
    }

    async fn fetch_policy(
        &self,
        request: Request<v1::FetchPolicyRequest>,
    ) -> Reply<Self::FetchPolicyStream> {
        let wanted = request.into_inner().version;
        let policy = self
            .desk
            .publisher()
            .newest()
            .filter(|policy| Some(policy.version()) == wanted)
            .ok_or_else(|| {
                ServiceError::NotFound("that policy version is superseded; fetch the newest".into())
            })?;
        let weights = policy.weights();
        let parts: Vec<Bytes> = (0..weights.len())
            .step_by(PART_BYTES)
            .map(|start| weights.slice(start..weights.len().min(start + PART_BYTES)))
            .collect();
        let stream = tokio_stream::iter(parts).map(|data| Ok(v1::PolicyPart { data }));
        Ok(Response::new(Box::pin(stream)))
    }

    async fn report_episode(
        &self,
        request: Request<v1::EpisodeReport>,
    ) -> Reply<v1::EpisodeReportReply> {
        self.desk.report(request.into_inner()).await?;
        Ok(Response::new(v1::EpisodeReportReply {}))
    }

    async fn status(&self, _: Request<v1::LearnerStatusRequest>) -> Reply<v1::LearnerStatus> {
        Ok(Response::new(self.desk.status().await?))
    }
}

/// Announces until the peer is gone, the policies are withdrawn, or the server stops: an open watch must not hold
/// up a shutdown.
async fn announce(
    mut watch: PolicyWatch,
    sender: mpsc::Sender<Result<v1::PolicyAnnouncement, Status>>,
    shutdown: CancellationToken,
) {
    loop {
        let next = tokio::select! {
            next = watch.next() => next,
            () = sender.closed() => return,
            () = shutdown.cancelled() => return,
        };
        let last = next.is_err();
        let sent = sender.send(next.map(|policy| policy.announcement())).await;
        if last || sent.is_err() {
            return;
        }
    }
}
