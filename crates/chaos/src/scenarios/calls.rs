//! Every call there is, as a stranger makes it.

use std::error::Error;
use std::time::Duration;

use isodream_core::config::EnvConfig;
use isodream_proto::v1::append_request::Kind as Append;
use isodream_proto::v1::environment_request::Kind as Environment;
use isodream_proto::v1::environment_service_client::EnvironmentServiceClient;
use isodream_proto::v1::sample_request::Kind as Sample;
use isodream_proto::{Identity, v1};
use isodream_rpc::{Dialer, RpcError};
use tokio_stream::{Stream, StreamExt as _};
use tonic::Status;

/// An actor that no store may know.
pub(super) const STRANGER: &str = "stranger";

/// How long an answer may take.
const PATIENCE: Duration = Duration::from_secs(15);

/// A method of one of the services.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Call {
    Append,
    Sample,
    ReplayStatus,
    WatchPolicy,
    FetchPolicy,
    ReportEpisode,
    LearnerStatus,
    Environment,
}

impl Call {
    pub(super) const ALL: [Self; 8] = [
        Self::Append,
        Self::Sample,
        Self::ReplayStatus,
        Self::WatchPolicy,
        Self::FetchPolicy,
        Self::ReportEpisode,
        Self::LearnerStatus,
        Self::Environment,
    ];
}

/// Where the services are.
#[derive(Debug, Clone)]
pub(super) struct Addresses {
    pub(super) replay: String,
    pub(super) learner: String,
    pub(super) environment: String,
}

/// Makes the call in a version of the protocol, and waits for its first answer.
pub(super) async fn make(
    dialer: Dialer,
    addresses: Addresses,
    call: Call,
    version: u32,
) -> Result<(), Status> {
    let made = async {
        match call {
            Call::Append | Call::Sample | Call::ReplayStatus => {
                at_replay(&dialer, &addresses.replay, call, version).await
            }
            Call::Environment => at_environment(&dialer, &addresses.environment, version).await,
            _ => at_learner(&dialer, &addresses.learner, call, version).await,
        }
    };
    match tokio::time::timeout(PATIENCE, made).await {
        Ok(answer) => answer,
        Err(_) => Err(Status::deadline_exceeded("no answer came")),
    }
}

async fn at_replay(dialer: &Dialer, address: &str, call: Call, version: u32) -> Result<(), Status> {
    let mut client = dialer.replay(address).map_err(|error| unusable(&error))?;
    match call {
        Call::Append => {
            let hello = v1::Hello {
                handshake: Some(handshake(version)?),
                actor_id: STRANGER.into(),
                epoch: 1,
                ..v1::Hello::default()
            };
            let chunk = v1::Chunk {
                actor_id: STRANGER.into(),
                epoch: 1,
                episode_id: 1,
                steps: 1,
                payload: vec![0; 10].into(),
                ..v1::Chunk::default()
            };
            let kinds = [Append::Hello(hello), Append::Chunk(chunk)];
            let requests = kinds.map(|kind| v1::AppendRequest { kind: Some(kind) });
            client
                .append(open(requests))
                .await?
                .into_inner()
                .message()
                .await
                .map(drop)
        }
        Call::Sample => {
            let hello = v1::SampleHello {
                handshake: Some(handshake(version)?),
                sequence_length: 8,
                table: "train".into(),
                ..v1::SampleHello::default()
            };
            let kind = Some(Sample::Hello(hello));
            let credit = Some(Sample::Credit(v1::SampleCredit {
                sequences: 1,
                unlimited: true,
            }));
            let requests = [kind, credit].map(|kind| v1::SampleRequest { kind });
            client
                .sample(open(requests))
                .await?
                .into_inner()
                .message()
                .await
                .map(drop)
        }
        _ => client.status(v1::ReplayStatusRequest {}).await.map(drop),
    }
}

async fn at_learner(
    dialer: &Dialer,
    address: &str,
    call: Call,
    version: u32,
) -> Result<(), Status> {
    let mut client = dialer.learner(address).map_err(|error| unusable(&error))?;
    match call {
        Call::WatchPolicy => {
            let request = v1::WatchPolicyRequest {
                handshake: Some(handshake(version)?),
                actor_id: STRANGER.into(),
            };
            client
                .watch_policy(request)
                .await?
                .into_inner()
                .message()
                .await
                .map(drop)
        }
        Call::FetchPolicy => {
            let request = v1::FetchPolicyRequest::default();
            client
                .fetch_policy(request)
                .await?
                .into_inner()
                .message()
                .await
                .map(drop)
        }
        Call::ReportEpisode => {
            let report = v1::EpisodeReport {
                actor_id: STRANGER.into(),
                ..v1::EpisodeReport::default()
            };
            client.report_episode(report).await.map(drop)
        }
        _ => client.status(v1::LearnerStatusRequest {}).await.map(drop),
    }
}

async fn at_environment(dialer: &Dialer, address: &str, version: u32) -> Result<(), Status> {
    let mut client =
        EnvironmentServiceClient::new(dialer.wire(address).map_err(|error| unusable(&error))?);
    let hello = v1::EnvironmentHello {
        protocol_version: version,
        ..v1::EnvironmentHello::default()
    };
    let kind = Some(Environment::Hello(hello));
    let requests = open([v1::EnvironmentRequest { kind }]);
    client
        .run(requests)
        .await?
        .into_inner()
        .message()
        .await
        .map(drop)
}

/// The right handshake, but for the version.
fn handshake(version: u32) -> Result<v1::Handshake, Status> {
    let config = EnvConfig {
        time_limit: 40,
        ..EnvConfig::default()
    };
    let spec = isodream_envs::spec(&config).map_err(|error| Status::unknown(error.to_string()))?;
    Ok(v1::Handshake {
        protocol_version: version,
        ..Identity::new(&spec, "").handshake()
    })
}

fn unusable(error: &RpcError) -> Status {
    Status::unknown(error.to_string())
}

/// The requests, and then silence: a stream that ends could be what is refused.
fn open<T>(requests: impl IntoIterator<Item = T>) -> impl Stream<Item = T> {
    tokio_stream::iter(requests).chain(tokio_stream::pending())
}

/// The status in words, with what lies behind it.
pub(super) fn with_causes(status: &Status) -> String {
    let mut words = status.message().to_owned();
    let mut source = status.source();
    while let Some(cause) = source {
        words = format!("{words}: {cause}");
        source = cause.source();
    }
    words
}
