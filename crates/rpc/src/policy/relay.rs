//! Handing out another's policies.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isodream_proto::{Mismatch, v1};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status};

use super::follow::{KeepPolicies, follow_policy};
use super::publisher::{PolicyPublisher, PolicyWatch};
use super::service::PolicyDesk;
use crate::error::words;
use crate::limits::HELLO_TIMEOUT;
use crate::{Dialer, LearnerClient, RpcError, ServiceError, is_refusal};

/// Handshakes that the learner accepted and the relay remembers; those of one run are alike.
const REMEMBERED: usize = 8;

/// Stands between a learner, or another relay, and any number of actors.
///
/// It has one connection to the learner, fetches every version once, verifies it and hands it on, and passes
/// reports and questions about the run through. While the learner is away, it serves what it has.
///
/// A relay has no configuration of its own: whether an actor belongs to the run is asked of the learner, once for
/// all actors with the same handshake, and refusals are the learner's own. So the first actor's handshake is
/// also the one that the relay follows the policy with. A learner that comes back as another run's refuses it, and
/// then every actor hears of that.
#[derive(Debug, Clone)]
pub struct PolicyRelay {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    upstream: String,
    name: String,
    client: LearnerClient,
    publisher: PolicyPublisher,
    accepted: Mutex<Accepted>,
    /// Held by the one who asks the learner: others wait for the answer instead of asking as well.
    asking: tokio::sync::Mutex<()>,
    stop: CancellationToken,
}

#[derive(Debug, Default)]
struct Accepted {
    handshakes: VecDeque<v1::Handshake>,
    /// The task that follows the policy; none before the first actor.
    follower: Option<Follower>,
}

#[derive(Debug)]
struct Follower {
    handshake: v1::Handshake,
    stop: CancellationToken,
}

impl PolicyRelay {
    /// A relay of the learner or relay at `upstream`, which knows it as `name`. It connects when the first actor
    /// comes, and ends with `stop`.
    ///
    /// # Errors
    /// [`RpcError::Address`] where `upstream` cannot be one.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn new(
        dialer: &Dialer,
        upstream: &str,
        name: impl Into<String>,
        stop: CancellationToken,
    ) -> Result<Self, RpcError> {
        Ok(Self {
            inner: Arc::new(Inner {
                client: dialer.learner(upstream)?,
                upstream: upstream.to_owned(),
                name: name.into(),
                publisher: PolicyPublisher::default(),
                accepted: Mutex::default(),
                asking: tokio::sync::Mutex::default(),
                stop,
            }),
        })
    }
}

#[tonic::async_trait]
impl PolicyDesk for PolicyRelay {
    fn publisher(&self) -> &PolicyPublisher {
        &self.inner.publisher
    }

    async fn admit(&self, request: &v1::WatchPolicyRequest) -> Result<PolicyWatch, Status> {
        let inner = &self.inner;
        let handshake = request
            .handshake
            .as_ref()
            .ok_or_else(|| ServiceError::from(Mismatch::Missing))?;
        if let Some(watch) = inner.known(handshake) {
            return Ok(watch);
        }
        let _turn = inner.asking.lock().await;
        if let Some(watch) = inner.known(handshake) {
            return Ok(watch);
        }
        inner.ask(request).await?;
        inner.check_follower(handshake).await?;
        Ok(inner.accept(handshake))
    }

    async fn report(&self, report: v1::EpisodeReport) -> Result<(), Status> {
        let mut client = self.inner.client.clone();
        match client.report_episode(report).await {
            Ok(_) => Ok(()),
            Err(status) => Err(self.inner.passed_on(&status)),
        }
    }

    async fn status(&self) -> Result<v1::LearnerStatus, Status> {
        let mut client = self.inner.client.clone();
        match client.status(v1::LearnerStatusRequest {}).await {
            Ok(status) => Ok(status.into_inner()),
            Err(status) => Err(self.inner.passed_on(&status)),
        }
    }
}

impl Inner {
    /// Whether the learner takes someone.
    async fn ask(&self, request: &v1::WatchPolicyRequest) -> Result<(), Status> {
        let mut client = self.client.clone();
        let asking = client.watch_policy(request.clone());
        match tokio::time::timeout(HELLO_TIMEOUT, asking).await {
            Ok(Ok(_)) => Ok(()),
            Ok(Err(status)) => Err(self.passed_on(&status)),
            Err(_) => {
                let late = Status::unavailable(format!("no answer within {HELLO_TIMEOUT:?}"));
                Err(self.passed_on(&late))
            }
        }
    }

    /// The learner has just accepted `handshake`, which is new. Where the policy is followed with another one,
    /// that may be of a run that the learner is not of any more: then its policies are withdrawn at once, so that
    /// no actor gets another run's.
    async fn check_follower(&self, handshake: &v1::Handshake) -> Result<(), Status> {
        let followed = {
            let accepted = self.accepted();
            let follower = accepted.follower.as_ref();
            follower.map(|follower| (follower.handshake.clone(), follower.stop.clone()))
        };
        let Some((followed, follower)) = followed.filter(|(other, _)| other != handshake) else {
            return Ok(());
        };
        match self.ask(&self.request(followed)).await {
            Err(refusal) if is_refusal(&refusal) => self.withdraw(&follower, refusal),
            answer => return answer,
        }
        Ok(())
    }

    /// A watch for an actor with a handshake that the learner accepted before.
    fn known(&self, handshake: &v1::Handshake) -> Option<PolicyWatch> {
        let accepted = self.accepted();
        // Under the lock: what is withdrawn later ends this watch.
        let known = accepted.handshakes.contains(handshake);
        known.then(|| self.publisher.watch())
    }

    /// Remembers a handshake, and follows the policy with it if nobody does yet.
    fn accept(self: &Arc<Self>, handshake: &v1::Handshake) -> PolicyWatch {
        let mut accepted = self.accepted();
        if accepted.handshakes.len() == REMEMBERED {
            accepted.handshakes.pop_front();
        }
        accepted.handshakes.push_back(handshake.clone());
        accepted.follower.get_or_insert_with(|| {
            let stop = self.stop.child_token();
            tokio::spawn(follow(self.clone(), handshake.clone(), stop.clone()));
            Follower {
                handshake: handshake.clone(),
                stop,
            }
        });
        self.publisher.watch()
    }

    /// Ends `follower` and everything that came by it, if it is still the one: whoever comes from now on is asked
    /// for anew.
    fn withdraw(&self, follower: &CancellationToken, why: Status) {
        let mut accepted = self.accepted();
        if follower.is_cancelled() {
            return;
        }
        follower.cancel();
        tracing::warn!(
            learner = self.upstream,
            why = words(&why),
            "the learner does not take this relay's actors any more"
        );
        *accepted = Accepted::default();
        self.publisher.withdraw(why);
    }

    /// How the relay itself introduces itself with an actor's handshake.
    fn request(&self, handshake: v1::Handshake) -> v1::WatchPolicyRequest {
        v1::WatchPolicyRequest {
            handshake: Some(handshake),
            actor_id: self.name.clone(),
        }
    }

    /// What an actor is told of the learner's answer. Only what the learner says of the actor is final for it:
    /// a relay that has the wrong token or the wrong address can be mended while actors wait.
    fn passed_on(&self, status: &Status) -> Status {
        match status.code() {
            Code::FailedPrecondition | Code::InvalidArgument => {
                Status::new(status.code(), status.message())
            }
            _ => Status::unavailable(format!(
                "the relay gets no answer from the learner at {}: {}",
                self.upstream,
                words(status)
            )),
        }
    }

    fn accepted(&self) -> MutexGuard<'_, Accepted> {
        self.accepted.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Follows the policy and hands it on until the relay stops or the learner refuses.
async fn follow(inner: Arc<Inner>, handshake: v1::Handshake, stop: CancellationToken) {
    let publisher = inner.publisher.clone();
    let sink = KeepPolicies::new(move |policy| publisher.publish(policy));
    let following = follow_policy(inner.client.clone(), inner.request(handshake), sink);
    if let Some(refusal) = stop.run_until_cancelled(following).await {
        inner.withdraw(&stop, inner.passed_on(&refusal));
    }
}
