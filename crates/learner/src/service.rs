//! The learner's gRPC door.

use std::pin::Pin;
use std::sync::Arc;

use bytes::Bytes;
use isodream_proto::v1::learner_service_server::LearnerService;
use isodream_proto::{Identity, v1};
use isodream_rpc::ServiceError;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status};

use crate::progress::Progress;
use crate::publisher::Publisher;

/// Bytes of weights per message.
const PART_BYTES: usize = 1 << 20;

pub(crate) struct Service {
    pub(crate) identity: Identity,
    pub(crate) publisher: Publisher,
    pub(crate) progress: Arc<Progress>,
    pub(crate) shutdown: CancellationToken,
}

type Reply<T> = Result<Response<T>, Status>;
type Streamed<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

#[tonic::async_trait]
impl LearnerService for Service {
    type WatchPolicyStream = Streamed<v1::PolicyAnnouncement>;
    type FetchPolicyStream = Streamed<v1::PolicyPart>;

    async fn watch_policy(
        &self,
        request: Request<v1::WatchPolicyRequest>,
    ) -> Reply<Self::WatchPolicyStream> {
        let request = request.into_inner();
        self.identity
            .check(request.handshake.as_ref())
            .map_err(ServiceError::from)?;
        tracing::info!(actor = request.actor_id, "an actor follows the policy");
        let (sender, announcements) = mpsc::channel(1);
        let (mut newest, shutdown) = (self.publisher.subscribe(), self.shutdown.clone());
        tokio::spawn(async move {
            loop {
                let policy = newest.borrow_and_update().clone();
                if let Some(policy) = policy
                    && sender.send(Ok(policy.announcement())).await.is_err()
                {
                    return;
                }
                // An open watch must not hold up a shutdown.
                let changed = tokio::select! {
                    changed = newest.changed() => changed.is_ok(),
                    () = shutdown.cancelled() => false,
                };
                if !changed {
                    return;
                }
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(announcements))))
    }

    async fn fetch_policy(
        &self,
        request: Request<v1::FetchPolicyRequest>,
    ) -> Reply<Self::FetchPolicyStream> {
        let wanted = request.into_inner().version;
        let policy = self
            .publisher
            .newest()
            .filter(|policy| Some(policy.version) == wanted)
            .ok_or_else(|| {
                ServiceError::NotFound("that policy version is superseded; fetch the newest".into())
            })?;
        let parts: Vec<Bytes> = (0..policy.weights.len())
            .step_by(PART_BYTES)
            .map(|start| {
                policy
                    .weights
                    .slice(start..policy.weights.len().min(start + PART_BYTES))
            })
            .collect();
        let stream = tokio_stream::iter(parts).map(|data| Ok(v1::PolicyPart { data }));
        Ok(Response::new(Box::pin(stream)))
    }

    async fn report_episode(
        &self,
        request: Request<v1::EpisodeReport>,
    ) -> Reply<v1::EpisodeReportReply> {
        self.progress.report(request.into_inner());
        Ok(Response::new(v1::EpisodeReportReply {}))
    }

    async fn status(&self, _: Request<v1::LearnerStatusRequest>) -> Reply<v1::LearnerStatus> {
        Ok(Response::new(self.progress.status()))
    }
}
