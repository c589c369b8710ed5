//! The newest policy, and those who wait for it.

use std::sync::Arc;

use bytes::Bytes;
use isodream_proto::{Identity, v1};
use sha2::{Digest, Sha256};
use tokio::sync::watch;
use tonic::Status;

use crate::ServiceError;

/// A published policy.
#[derive(Debug, Clone, PartialEq)]
pub struct Policy {
    version: v1::PolicyVersion,
    weights: Bytes,
    content_hash: String,
}

impl Policy {
    /// The policy `version` with `weights`, safetensors bytes.
    pub fn new(version: v1::PolicyVersion, weights: impl Into<Bytes>) -> Self {
        let weights = weights.into();
        let content_hash = hexadecimal(&Sha256::digest(&weights));
        Self {
            version,
            weights,
            content_hash,
        }
    }

    /// A policy whose `weights` were found to have the hash `content_hash`.
    pub(super) fn verified(
        version: v1::PolicyVersion,
        weights: Vec<u8>,
        content_hash: String,
    ) -> Self {
        Self {
            version,
            weights: weights.into(),
            content_hash,
        }
    }

    /// Its place in the order of versions.
    pub fn version(&self) -> v1::PolicyVersion {
        self.version
    }

    /// Safetensors bytes.
    pub fn weights(&self) -> &Bytes {
        &self.weights
    }

    pub(super) fn announcement(&self) -> v1::PolicyAnnouncement {
        v1::PolicyAnnouncement {
            version: Some(self.version),
            content_hash: self.content_hash.clone(),
            bytes: self.weights.len() as u64,
        }
    }
}

/// A hash as announcements carry it.
pub(super) fn hexadecimal(digest: &[u8]) -> String {
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Holds the newest policy; those who watch see only the newest, however slow they are.
#[derive(Debug, Clone, Default)]
pub struct PolicyPublisher {
    shelf: watch::Sender<Shelf>,
}

#[derive(Debug, Default)]
struct Shelf {
    newest: Option<Arc<Policy>>,
    /// How often everything was withdrawn, and why the last time.
    withdrawals: u64,
    why: Option<Status>,
}

impl PolicyPublisher {
    /// Makes `policy` the newest.
    pub fn publish(&self, policy: Policy) {
        self.shelf
            .send_modify(|shelf| shelf.newest = Some(Arc::new(policy)));
    }

    /// The newest policy; none before the first one.
    pub fn newest(&self) -> Option<Arc<Policy>> {
        self.shelf.borrow().newest.clone()
    }

    /// Forgets the policy and ends every watch with `why`. Later watches wait for the next policy.
    pub(super) fn withdraw(&self, why: Status) {
        self.shelf.send_modify(|shelf| {
            shelf.newest = None;
            shelf.withdrawals += 1;
            shelf.why = Some(why);
        });
    }

    /// [`PolicyPublisher::watch`] for a peer that works on the same as `identity`.
    ///
    /// # Errors
    /// A refusal (`FAILED_PRECONDITION`) that names what differs.
    pub fn watch_for(
        &self,
        identity: &Identity,
        request: &v1::WatchPolicyRequest,
    ) -> Result<PolicyWatch, Status> {
        identity
            .check(request.handshake.as_ref())
            .map_err(ServiceError::from)?;
        Ok(self.watch())
    }

    /// Watches the policies from the newest on.
    pub fn watch(&self) -> PolicyWatch {
        let shelf = self.shelf.subscribe();
        let withdrawals = shelf.borrow().withdrawals;
        PolicyWatch {
            shelf,
            withdrawals,
            seen: None,
        }
    }
}

/// One party's view of a [`PolicyPublisher`].
#[derive(Debug)]
pub struct PolicyWatch {
    shelf: watch::Receiver<Shelf>,
    withdrawals: u64,
    seen: Option<v1::PolicyVersion>,
}

impl PolicyWatch {
    /// The newest policy that this watch has not returned yet; waits for one.
    ///
    /// # Errors
    /// Why the policies were withdrawn.
    pub(super) async fn next(&mut self) -> Result<Arc<Policy>, Status> {
        loop {
            {
                let shelf = self.shelf.borrow_and_update();
                if shelf.withdrawals != self.withdrawals {
                    return Err(shelf.why.clone().unwrap_or_else(ended));
                }
                if let Some(policy) = &shelf.newest
                    && self.seen != Some(policy.version)
                {
                    self.seen = Some(policy.version);
                    return Ok(policy.clone());
                }
            }
            self.shelf.changed().await.map_err(|_| ended())?;
        }
    }
}

fn ended() -> Status {
    Status::unavailable("the publisher of policies ended; connect again")
}
