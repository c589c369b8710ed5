//! The actor's connection to the learner: newest policy in, episode reports out.

use std::sync::Arc;

use anyhow::{Context, bail};
use isodream_proto::{Identity, v1};
use isodream_rpc::{Dialer, LearnerClient, is_refusal, reconnect_delays, retry};
use sha2::{Digest, Sha256};
use tokio::sync::{mpsc, watch};

/// Reports on their way to the learner at most; the newest are dropped beyond it, with a warning.
const REPORT_QUEUE: usize = 64;

/// Tries of one report before it is given up.
const REPORT_ATTEMPTS: usize = 5;

/// A policy as the learner published it.
#[derive(Debug)]
pub(crate) struct PublishedPolicy {
    /// Its place in the order of versions.
    pub(crate) version: v1::PolicyVersion,
    /// Safetensors bytes, their hash checked.
    pub(crate) weights: Vec<u8>,
}

/// What the watch knows.
#[derive(Debug, Clone, Default)]
pub(crate) struct PolicyNews {
    /// The newest policy; none until the learner publishes.
    pub(crate) newest: Option<Arc<PublishedPolicy>>,
    /// Why the learner will never talk to this actor.
    pub(crate) refused: Option<String>,
}

/// Connects in the background, for ever, and keeps the newest policy.
#[derive(Debug)]
pub(crate) struct LearnerLink {
    address: String,
    policy: watch::Receiver<PolicyNews>,
    reports: mpsc::Sender<v1::EpisodeReport>,
}

impl LearnerLink {
    /// Starts the link.
    pub(crate) fn start(
        dialer: &Dialer,
        address: &str,
        identity: &Identity,
        actor_id: &str,
    ) -> anyhow::Result<Self> {
        let client = dialer.learner(address)?;
        let (sender, policy) = watch::channel(PolicyNews::default());
        let request = v1::WatchPolicyRequest {
            handshake: Some(identity.handshake()),
            actor_id: actor_id.to_owned(),
        };
        let watching = client.clone();
        tokio::spawn(async move {
            let mut delays = reconnect_delays();
            let mut told = String::new();
            while !sender.is_closed() {
                let before = version_of(&sender);
                if let Err(error) = follow(watching.clone(), &request, &sender).await {
                    let refused = error
                        .downcast_ref::<tonic::Status>()
                        .is_some_and(is_refusal);
                    if refused {
                        sender.send_modify(|news| news.refused = Some(format!("{error:#}")));
                        return;
                    }
                    let error = format!("{error:#}");
                    // Once for each reason: a learner may be away for long.
                    if error != told {
                        tracing::warn!(error, "the learner is out of reach, trying again");
                        told = error;
                    }
                }
                if version_of(&sender) != before {
                    delays = reconnect_delays();
                }
                tokio::time::sleep(delays.next().unwrap_or_default()).await;
            }
        });
        let (reports, mut queue) = mpsc::channel::<v1::EpisodeReport>(REPORT_QUEUE);
        tokio::spawn(async move {
            while let Some(report) = queue.recv().await {
                let send = || {
                    let (mut client, report) = (client.clone(), report.clone());
                    async move { client.report_episode(report).await }
                };
                if let Err(status) = retry(REPORT_ATTEMPTS, send).await {
                    tracing::warn!(error = %status, "an episode's report was lost");
                }
            }
        });
        Ok(Self {
            address: address.to_owned(),
            policy,
            reports,
        })
    }

    /// The newest policy; none until the learner has published one.
    ///
    /// # Errors
    /// Where the learner refused this actor for good.
    pub(crate) fn newest(&self) -> anyhow::Result<Option<Arc<PublishedPolicy>>> {
        let news = self.policy.borrow();
        if let Some(reason) = &news.refused {
            bail!(
                "the learner at {} refused this actor: {reason}",
                self.address
            );
        }
        Ok(news.newest.clone())
    }

    /// Queues a report.
    pub(crate) fn report(&self, report: v1::EpisodeReport) {
        if self.reports.try_send(report).is_err() {
            tracing::warn!("an episode's report was dropped: the learner does not take them");
        }
    }
}

fn version_of(sender: &watch::Sender<PolicyNews>) -> Option<v1::PolicyVersion> {
    sender.borrow().newest.as_ref().map(|policy| policy.version)
}

/// Follows announcements until the stream ends.
async fn follow(
    mut client: LearnerClient,
    request: &v1::WatchPolicyRequest,
    sender: &watch::Sender<PolicyNews>,
) -> anyhow::Result<()> {
    let mut announcements = client.watch_policy(request.clone()).await?.into_inner();
    while let Some(announcement) = announcements.message().await? {
        let version = announcement
            .version
            .context("an announcement without a version")?;
        let fetch = v1::FetchPolicyRequest {
            version: Some(version),
        };
        let mut parts = match client.fetch_policy(fetch).await {
            Ok(parts) => parts.into_inner(),
            // Superseded meanwhile: the next announcement is on its way.
            Err(status) if status.code() == tonic::Code::NotFound => continue,
            Err(status) => return Err(status.into()),
        };
        let mut weights = Vec::new();
        while let Some(part) = parts.message().await? {
            weights.extend_from_slice(&part.data);
        }
        let hash: String = Sha256::digest(&weights)
            .iter()
            .map(|b| format!("{b:02x}"))
            .collect();
        if hash != announcement.content_hash {
            bail!(
                "policy {} arrived damaged: its hash differs",
                version.version
            );
        }
        sender
            .send_modify(|news| news.newest = Some(Arc::new(PublishedPolicy { version, weights })));
    }
    Ok(())
}
