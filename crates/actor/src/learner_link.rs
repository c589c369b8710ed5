//! The actor's connection to the learner: newest policy in, episode reports out.

use std::sync::Arc;

use anyhow::bail;
use isodream_proto::{Identity, v1};
use isodream_rpc::{Dialer, KeepPolicies, Policy, follow_policy, retry};
use tokio::sync::{mpsc, watch};

/// Reports on their way to the learner at most; the newest are dropped beyond it, with a warning.
const REPORT_QUEUE: usize = 64;

/// Tries of one report before it is given up.
const REPORT_ATTEMPTS: usize = 5;

/// What the watch knows.
#[derive(Debug, Clone, Default)]
pub(crate) struct PolicyNews {
    /// The newest policy; none until the learner publishes.
    pub(crate) newest: Option<Arc<Policy>>,
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
            let sink = KeepPolicies::new(|policy| {
                sender.send_modify(|news| news.newest = Some(Arc::new(policy)));
            });
            tokio::select! {
                refusal = follow_policy(watching, request, sink) => sender.send_modify(|news| {
                    news.refused = Some(refusal.message().to_owned());
                }),
                () = sender.closed() => {}
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
    pub(crate) fn newest(&self) -> anyhow::Result<Option<Arc<Policy>>> {
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
