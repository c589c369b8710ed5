//! Servers as they are in the other build.

use isodream_proto::v1::environment_reply::Kind as EnvironmentAnswer;
use isodream_proto::v1::environment_service_server::EnvironmentService;
use isodream_proto::v1::learner_service_server::LearnerService;
use isodream_proto::v1::replay_service_server::ReplayService;
use isodream_proto::{Mismatch, PROTOCOL_VERSION, v1};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::OTHER;

/// Refuses everybody who greets, as that build would.
pub(super) struct Old;

fn mismatch() -> Status {
    let mismatch = Mismatch::Protocol {
        ours: OTHER,
        theirs: PROTOCOL_VERSION,
    };
    Status::failed_precondition(mismatch.to_string())
}

type Replies<T> = ReceiverStream<Result<T, Status>>;

#[tonic::async_trait]
impl ReplayService for Old {
    type AppendStream = Replies<v1::AppendReply>;
    type SampleStream = Replies<v1::SampleReply>;

    async fn append(
        &self,
        _: Request<Streaming<v1::AppendRequest>>,
    ) -> Result<Response<Self::AppendStream>, Status> {
        Err(mismatch())
    }

    async fn sample(
        &self,
        _: Request<Streaming<v1::SampleRequest>>,
    ) -> Result<Response<Self::SampleStream>, Status> {
        Err(mismatch())
    }

    async fn status(
        &self,
        _: Request<v1::ReplayStatusRequest>,
    ) -> Result<Response<v1::ReplayStatus>, Status> {
        Ok(Response::new(v1::ReplayStatus {
            store_id: "old".into(),
            ..v1::ReplayStatus::default()
        }))
    }
}

#[tonic::async_trait]
impl LearnerService for Old {
    type WatchPolicyStream = Replies<v1::PolicyAnnouncement>;
    type FetchPolicyStream = Replies<v1::PolicyPart>;

    async fn watch_policy(
        &self,
        _: Request<v1::WatchPolicyRequest>,
    ) -> Result<Response<Self::WatchPolicyStream>, Status> {
        Err(mismatch())
    }

    async fn fetch_policy(
        &self,
        _: Request<v1::FetchPolicyRequest>,
    ) -> Result<Response<Self::FetchPolicyStream>, Status> {
        Err(mismatch())
    }

    async fn report_episode(
        &self,
        _: Request<v1::EpisodeReport>,
    ) -> Result<Response<v1::EpisodeReportReply>, Status> {
        Ok(Response::new(Default::default()))
    }

    async fn status(
        &self,
        _: Request<v1::LearnerStatusRequest>,
    ) -> Result<Response<v1::LearnerStatus>, Status> {
        Ok(Response::new(Default::default()))
    }
}

#[tonic::async_trait]
impl EnvironmentService for Old {
    type RunStream = Replies<v1::EnvironmentReply>;

    async fn run(
        &self,
        _: Request<Streaming<v1::EnvironmentRequest>>,
    ) -> Result<Response<Self::RunStream>, Status> {
        let (sender, receiver) = mpsc::channel(1);
        let welcome = EnvironmentAnswer::Welcome(v1::EnvironmentWelcome {
            protocol_version: OTHER,
            ..v1::EnvironmentWelcome::default()
        });
        let _ = sender.try_send(Ok(v1::EnvironmentReply {
            kind: Some(welcome),
        }));
        Ok(Response::new(ReceiverStream::new(receiver)))
    }
}
