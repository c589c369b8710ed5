//! A learner's receiving side: it draws as fast as the ratio lets it, and drops what it gets undecoded.

use std::collections::BTreeMap;
use std::sync::Arc;

use isodream_core::Config;
use isodream_proto::Identity;
use isodream_rpc::{RpcError, SampleClient, SampleOptions};

use super::board::Board;

/// What learner `index` asks for.
pub(super) fn sampling(
    config: &Config,
    identity: &Identity,
    replay: &[String],
    index: u64,
) -> SampleOptions {
    SampleOptions {
        addresses: replay.to_vec(),
        identity: identity.clone(),
        sequence_length: config.learner.batch_length as u32,
        table: config.learner.table.clone(),
        learner_epoch: 0,
        seed: index,
        prefetch: config.learner.batch_size * config.learner.prefetch_batches,
        sampled_steps: BTreeMap::new(),
        unlimited_sequences: 0,
    }
}

/// Draws until it is refused.
pub(super) async fn draw(mut client: SampleClient, length: u32, board: Arc<Board>) -> RpcError {
    loop {
        match client.next().await {
            Ok(sequence) => {
                let bytes: usize = sequence.chunks.iter().map(|c| c.payload.len()).sum();
                board.count(&board.samples, u64::from(length));
                board.count(&board.sample_bytes, bytes as u64);
            }
            Err(error) => return error,
        }
    }
}
