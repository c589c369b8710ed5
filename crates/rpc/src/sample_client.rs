//! Drawing experience.

use std::collections::BTreeMap;
use std::sync::Arc;

use isodream_core::{Chunk, EpisodeId};
use isodream_proto::Identity;
use tokio::sync::mpsc;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::append_client::check_addresses;
use crate::priorities::{PriorityHandle, PriorityUpdate, priorities};
use crate::sample_merge::SampleMerge;
use crate::sample_watch::SampleWatch;
use crate::{Dialer, RpcError};

/// Settings of a [`SampleClient`].
#[derive(Debug, Clone)]
pub struct SampleOptions {
    /// The replay-servers, `host:port`. A name may stand for several, and is looked up every few seconds
    /// ([`crate::limits::RESOLVE_INTERVAL`]), so that a new one needs no restart.
    pub addresses: Vec<String>,
    /// What this side works on.
    pub identity: Identity,
    /// Steps per sequence.
    pub sequence_length: u32,
    /// The servers' table to draw from.
    pub table: String,
    /// Greater than at any earlier start of the run's learner: older ones are fenced off from limited tables. 0 takes
    /// no part in that.
    pub learner_epoch: u64,
    /// Seed of the draws.
    pub seed: u64,
    /// Sequences on their way or buffered at most; at least one batch, and more than there are servers.
    pub prefetch: usize,
    /// Steps drawn from a limited table of each store so far: empty, or [`SampledSequence::sampled_steps`] of the
    /// last sequence of each [`SampledSequence::store_id`] that a checkpoint has seen.
    pub sampled_steps: BTreeMap<String, u64>,
    /// The first sequences, for pretraining, which do not count against the limiter.
    pub unlimited_sequences: u64,
}

/// A drawn sequence, still compressed.
#[derive(Debug, Clone, PartialEq)]
pub struct SampledSequence {
    /// The episode.
    pub episode_id: EpisodeId,
    /// Index within the episode of the sequence's first step.
    pub start_step: u32,
    /// Probability of this draw among all that its store could have made, for importance weights.
    pub probability: f64,
    /// Contiguous chunks that cover the sequence.
    pub chunks: Vec<Chunk>,
    /// Steps of the first chunk that precede the sequence.
    pub offset: u32,
    /// The store that it was drawn from.
    pub store_id: Arc<str>,
    /// Steps drawn under the limiter of this store up to and with this sequence: what a checkpoint that has
    /// used it keeps.
    pub sampled_steps: u64,
}

/// Draws sequences from all replay-servers in proportion to the steps that each holds, ahead of use.
///
/// Each server has a limiter of its own, so that in the long run its share of the draws is its share of the
/// insertions: where that limiter makes draws wait, they are made elsewhere meanwhile. So is what a server that
/// is away cannot serve; the count of its store is kept until it is back.
///
/// A task of its own reconnects for as long as the client lives. Dropping the client ends it.
#[derive(Debug)]
pub struct SampleClient {
    sequences: mpsc::Receiver<SampledSequence>,
    priorities: PriorityHandle,
    watch: SampleWatch,
    peers: String,
    _task: DropGuard,
}

impl SampleClient {
    /// Starts the client; it connects in the background.
    ///
    /// # Errors
    /// [`RpcError::Address`] where an address cannot be one or there is none, [`RpcError::Tls`] where the dialer's
    /// certificates make no sense.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn start(dialer: &Dialer, options: SampleOptions) -> Result<Self, RpcError> {
        let peers = check_addresses(dialer, &options.addresses)?;
        // One credit at each server may be stuck, and that must not hold the others up.
        let capacity = options.prefetch.max(2 * options.addresses.len());
        let (sender, sequences) = mpsc::channel(capacity);
        let watch = SampleWatch::default();
        let (priorities, updates) = priorities(watch.clone(), peers.clone());
        let merge = SampleMerge::new(dialer.clone(), options, sender, updates, watch.clone());
        let cancel = CancellationToken::new();
        let cancelled = cancel.clone();
        tokio::spawn(cancelled.run_until_cancelled_owned(merge.run()));
        Ok(Self {
            sequences,
            priorities,
            watch,
            peers,
            _task: cancel.drop_guard(),
        })
    }

    /// The next sequence; waits for it, over reconnections. Dropping the future loses nothing.
    ///
    /// # Errors
    /// [`RpcError::Refused`] where the server refused this client for good.
    pub async fn next(&mut self) -> Result<SampledSequence, RpcError> {
        let sequence = self.sequences.recv().await;
        sequence.ok_or_else(|| self.end())
    }

    /// [`SampleClient::next`] for threads without a runtime.
    ///
    /// # Errors
    /// As [`SampleClient::next`].
    ///
    /// # Panics
    /// On a thread that drives async tasks.
    pub fn next_blocking(&mut self) -> Result<SampledSequence, RpcError> {
        let sequence = self.sequences.blocking_recv();
        sequence.ok_or_else(|| self.end())
    }

    /// [`PriorityHandle::update`].
    ///
    /// # Errors
    /// As there.
    pub async fn update_priorities(&self, updates: Vec<PriorityUpdate>) -> Result<(), RpcError> {
        self.priorities.update(updates).await
    }

    /// A handle that sets priorities while another thread holds the client.
    pub fn priorities(&self) -> PriorityHandle {
        self.priorities.clone()
    }

    /// Sequences that [`SampleClient::next`] would return at once.
    pub fn buffered(&self) -> usize {
        self.sequences.len()
    }

    /// Why no sequences arrive, in words; none where they do.
    pub fn waiting(&self) -> Option<String> {
        self.watch.waiting()
    }

    /// What is known of the servers, for others while a thread holds the client.
    pub fn watch(&self) -> SampleWatch {
        self.watch.clone()
    }

    fn end(&self) -> RpcError {
        self.watch.end_of(&self.peers)
    }
}
