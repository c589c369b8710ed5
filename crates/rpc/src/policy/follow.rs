//! Following a learner's policies.

use bytes::Bytes;
use isodream_proto::v1;
use sha2::{Digest, Sha256};
use tokio::time::Instant;
use tonic::{Code, Status};
use tracing::Instrument as _;

use super::publisher::{Policy, hexadecimal};
use crate::error::words;
use crate::limits::{MAX_MESSAGE_BYTES, RECONNECT_DELAYS};
use crate::{LearnerClient, is_refusal, reconnect_delays};

/// Takes policies in, part by part.
pub trait PolicySink: Send {
    /// The parts that follow are of this policy; those of another that was not complete are void.
    fn begin(&mut self, announcement: &v1::PolicyAnnouncement);

    /// The next bytes of the weights.
    fn part(&mut self, part: Bytes);

    /// The policy `version` is complete, and its bytes have the announced hash.
    fn complete(&mut self, version: v1::PolicyVersion);
}

/// A sink that keeps the weights and hands every complete policy to a function.
#[derive(Debug)]
pub struct KeepPolicies<F> {
    take: F,
    weights: Vec<u8>,
    content_hash: String,
}

impl<F: FnMut(Policy) + Send> KeepPolicies<F> {
    /// Hands policies to `take`.
    pub fn new(take: F) -> Self {
        Self {
            take,
            weights: Vec::new(),
            content_hash: String::new(),
        }
    }
}

impl<F: FnMut(Policy) + Send> PolicySink for KeepPolicies<F> {
    fn begin(&mut self, announcement: &v1::PolicyAnnouncement) {
        // Room for what is announced, within reason: the bytes are counted as they arrive.
        let room = usize::try_from(announcement.bytes).unwrap_or(usize::MAX);
        self.weights = Vec::with_capacity(room.min(MAX_MESSAGE_BYTES));
        self.content_hash.clone_from(&announcement.content_hash);
    }

    fn part(&mut self, part: Bytes) {
        self.weights.extend_from_slice(&part);
    }

    fn complete(&mut self, version: v1::PolicyVersion) {
        let weights = std::mem::take(&mut self.weights);
        let content_hash = std::mem::take(&mut self.content_hash);
        (self.take)(Policy::verified(version, weights, content_hash));
    }
}

/// Follows the policies of the learner, or relay, behind `client`: watches, fetches every version that it hears
/// of, and verifies it. Connects again for as long as it is polled.
///
/// Returns only when it is refused for good ([`is_refusal`]), with the peer's status.
pub async fn follow_policy(
    client: LearnerClient,
    request: v1::WatchPolicyRequest,
    mut sink: impl PolicySink,
) -> Status {
    let mut delays = reconnect_delays();
    loop {
        let mut progressed = false;
        let since = Instant::now();
        let mut client = client.clone();
        if let Err(status) = connection(&mut client, &request, &mut sink, &mut progressed).await {
            if is_refusal(&status) {
                return Status::new(status.code(), words(&status));
            }
            tracing::debug!(error = words(&status), "the learner is out of reach");
        }
        if progressed || since.elapsed() > RECONNECT_DELAYS.1 {
            delays = reconnect_delays();
        }
        tokio::time::sleep(delays.next().unwrap_or_default()).await;
    }
}

/// Follows announcements until the stream ends.
async fn connection(
    client: &mut LearnerClient,
    request: &v1::WatchPolicyRequest,
    sink: &mut impl PolicySink,
    progressed: &mut bool,
) -> Result<(), Status> {
    let mut announcements = client.watch_policy(request.clone()).await?.into_inner();
    while let Some(announcement) = announcements.message().await? {
        let version = announcement.version.map(|version| version.version);
        let span = tracing::debug_span!("fetch_policy", version, bytes = announcement.bytes);
        match fetch(client, &announcement, sink).instrument(span).await {
            Ok(()) => *progressed = true,
            // Superseded meanwhile: the next announcement is on its way.
            Err(status) if status.code() == Code::NotFound => {}
            Err(status) => return Err(status),
        }
    }
    Ok(())
}

async fn fetch(
    client: &mut LearnerClient,
    announcement: &v1::PolicyAnnouncement,
    sink: &mut impl PolicySink,
) -> Result<(), Status> {
    let version = announcement
        .version
        .ok_or_else(|| Status::data_loss("a policy was announced without its version"))?;
    let request = v1::FetchPolicyRequest {
        version: Some(version),
    };
    let mut parts = client.fetch_policy(request).await?.into_inner();
    sink.begin(announcement);
    let mut hash = Sha256::new();
    let mut missing = announcement.bytes;
    while let Some(v1::PolicyPart { data }) = parts.message().await? {
        missing = missing.checked_sub(data.len() as u64).ok_or_else(|| {
            Status::data_loss(format!(
                "policy {} is larger than the {} bytes that were announced",
                version.version, announcement.bytes
            ))
        })?;
        hash.update(&data);
        sink.part(data);
    }
    if hexadecimal(&hash.finalize()) != announcement.content_hash {
        return Err(Status::data_loss(format!(
            "policy {} arrived damaged: its hash differs",
            version.version
        )));
    }
    sink.complete(version);
    Ok(())
}
