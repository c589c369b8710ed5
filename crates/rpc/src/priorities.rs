//! Priorities on their way from the learner to its table.

use std::sync::Arc;

use isodream_core::EpisodeId;
use isodream_proto::v1::PriorityUpdates;
use tokio::sync::mpsc;

use crate::RpcError;
use crate::sample_watch::SampleWatch;

/// Batches of updates that wait for a server at most.
pub(crate) const BATCHES_AHEAD: usize = 64;

/// The new priority of a sequence, named by where it starts.
#[derive(Debug, Clone, PartialEq)]
pub struct PriorityUpdate {
    /// The store that it was drawn from.
    pub store_id: Arc<str>,
    /// The episode.
    pub episode_id: EpisodeId,
    /// Index within the episode of the sequence's first step.
    pub start_step: u32,
    /// 0 or greater, and finite.
    pub priority: f32,
}

/// Sets priorities in a [`crate::SampleClient`]'s table; clones share the client's connections.
#[derive(Debug, Clone)]
pub struct PriorityHandle {
    batches: mpsc::Sender<Vec<PriorityUpdate>>,
    watch: SampleWatch,
    peers: String,
}

impl PriorityHandle {
    /// Sends a batch. Nothing is answered: servers ignore updates of sequences that they do not hold any more,
    /// and updates for a server that is away or many batches behind are dropped. A table without priorities,
    /// and a priority out of range, make the server refuse the client for good.
    ///
    /// # Errors
    /// [`RpcError::Refused`] or [`RpcError::Closed`] where the client is at its end.
    pub async fn update(&self, updates: Vec<PriorityUpdate>) -> Result<(), RpcError> {
        let sent = self.batches.send(updates).await;
        sent.map_err(|_| self.watch.end_of(&self.peers))
    }
}

/// A handle and the batches that it is given.
pub(crate) fn priorities(
    watch: SampleWatch,
    peers: String,
) -> (PriorityHandle, mpsc::Receiver<Vec<PriorityUpdate>>) {
    let (batches, receiver) = mpsc::channel(BATCHES_AHEAD);
    let handle = PriorityHandle {
        batches,
        watch,
        peers,
    };
    (handle, receiver)
}

/// Updates as a server takes them.
pub(crate) fn message<'a>(updates: impl Iterator<Item = &'a PriorityUpdate>) -> PriorityUpdates {
    let mut message = PriorityUpdates::default();
    for update in updates {
        message.episode_ids.push(update.episode_id);
        message.start_steps.push(update.start_step);
        message.priorities.push(update.priority);
    }
    message
}
