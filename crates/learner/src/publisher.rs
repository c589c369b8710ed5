//! The newest policy, and those who wait for it.

use std::sync::Arc;

use bytes::Bytes;
use isodream_proto::v1;
use sha2::{Digest, Sha256};
use tokio::sync::watch;

/// A published policy.
#[derive(Debug)]
pub(crate) struct Policy {
    pub(crate) version: v1::PolicyVersion,
    pub(crate) weights: Bytes,
    content_hash: String,
}

impl Policy {
    pub(crate) fn announcement(&self) -> v1::PolicyAnnouncement {
        v1::PolicyAnnouncement {
            version: Some(self.version),
            content_hash: self.content_hash.clone(),
            bytes: self.weights.len() as u64,
        }
    }
}

/// Holds the newest policy; subscribers see only the newest, however slow they are.
#[derive(Debug, Clone)]
pub(crate) struct Publisher {
    learner_epoch: u64,
    newest: watch::Sender<Option<Arc<Policy>>>,
}

impl Publisher {
    pub(crate) fn new(learner_epoch: u64) -> Self {
        Self {
            learner_epoch,
            newest: watch::Sender::new(None),
        }
    }

    pub(crate) fn publish(&self, version: u64, weights: Vec<u8>) {
        let content_hash = Sha256::digest(&weights)
            .iter()
            .map(|b| format!("{b:02x}"))
            .collect();
        let policy = Policy {
            version: v1::PolicyVersion {
                learner_epoch: self.learner_epoch,
                version,
            },
            weights: weights.into(),
            content_hash,
        };
        self.newest.send_replace(Some(Arc::new(policy)));
    }

    pub(crate) fn newest(&self) -> Option<Arc<Policy>> {
        self.newest.borrow().clone()
    }

    pub(crate) fn subscribe(&self) -> watch::Receiver<Option<Arc<Policy>>> {
        self.newest.subscribe()
    }
}
