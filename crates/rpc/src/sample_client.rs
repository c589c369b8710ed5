//! Drawing experience.

use std::sync::Arc;

use isodream_core::Chunk;
use isodream_proto::Identity;
use tokio::sync::mpsc;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::link_state::LinkState;
use crate::sample_link::SampleLink;
use crate::{RpcError, replay_client};

/// Settings of a [`SampleClient`].
#[derive(Debug, Clone)]
pub struct SampleOptions {
    /// The replay-server, `host:port`.
    pub address: String,
    /// What this side works on.
    pub identity: Identity,
    /// Steps per sequence.
    pub sequence_length: u32,
    /// Seed of the draws.
    pub seed: u64,
    /// Sequences on their way or buffered at most; at least one batch.
    pub prefetch: usize,
    /// Steps drawn under the limiter so far: 0, or [`SampledSequence::sampled_steps`] of the last sequence a
    /// checkpoint has seen.
    pub sampled_steps: u64,
    /// The first sequences, for pretraining, which do not count against the limiter.
    pub unlimited_sequences: u64,
}

/// A drawn sequence, still compressed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SampledSequence {
    /// Contiguous chunks that cover the sequence.
    pub chunks: Vec<Chunk>,
    /// Steps of the first chunk that precede the sequence.
    pub offset: u32,
    /// Steps drawn under the limiter up to and with this sequence: what a checkpoint that has used it keeps.
    pub sampled_steps: u64,
}

/// Draws sequences from a replay-server, ahead of use.
///
/// A task of its own reconnects for as long as the client lives. Dropping the client ends it.
#[derive(Debug)]
pub struct SampleClient {
    sequences: mpsc::Receiver<SampledSequence>,
    state: Arc<LinkState>,
    _task: DropGuard,
}

impl SampleClient {
    /// Starts the client; it connects in the background.
    ///
    /// # Errors
    /// [`RpcError::Address`] where the address cannot be one.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn start(options: SampleOptions) -> Result<Self, RpcError> {
        let client = replay_client(&options.address)?;
        let state = Arc::new(LinkState::new(&format!(
            "replay-server {}",
            options.address
        )));
        let (sender, sequences) = mpsc::channel(options.prefetch.max(1));
        let cancel = CancellationToken::new();
        let mut link = SampleLink::new(client, options, sender, state.clone());
        let (cancelled, ended) = (cancel.clone(), state.clone());
        tokio::spawn(async move {
            tokio::select! {
                () = cancelled.cancelled() => ended.end(ended.closed()),
                () = link.run() => {}
            }
        });
        Ok(Self {
            sequences,
            state,
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

    /// Sequences that [`SampleClient::next`] would return at once.
    pub fn buffered(&self) -> usize {
        self.sequences.len()
    }

    /// Why no sequences arrive, in words; none where they do.
    pub fn waiting(&self) -> Option<String> {
        self.state.waiting()
    }

    /// A handle that answers [`SampleClient::waiting`] while another thread holds the client.
    pub fn watch(&self) -> impl Fn() -> Option<String> + Send + Sync + 'static + use<> {
        let state = self.state.clone();
        move || state.waiting()
    }

    fn end(&self) -> RpcError {
        self.state.ended().unwrap_or_else(|| self.state.closed())
    }
}
