//! `[replay]` and `[replay.tables]`

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The table that is always there.
pub(super) const TRAIN_TABLE: &str = "train";

/// The replay-server.
#[derive(Debug, Clone, PartialEq, JsonSchema, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReplayConfig {
    /// Steps kept; the oldest episodes go first. 0 keeps all.
    pub capacity_steps: u64,
    /// Megabytes of records kept; the oldest episodes go first. 0 keeps all. Disk space is freed in whole segments.
    pub capacity_mb: u64,
    /// Bytes after which a log segment is closed.
    pub segment_bytes: u64,
    /// Steps per chunk that an actor sends.
    pub chunk_steps: usize,
    /// Batches that sampling may run ahead of or behind its ratio to insertion.
    pub limiter_tolerance_batches: f64,
    /// What learners may draw from, by name. All tables share the same steps and copy none; one that nobody
    /// draws from costs nothing. A new name begins with the defaults of a table.
    pub tables: BTreeMap<String, TableConfig>,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        Self {
            capacity_steps: 0,
            capacity_mb: 0,
            segment_bytes: 64 << 20,
            chunk_steps: 16,
            limiter_tolerance_batches: 20.0,
            tables: BTreeMap::from([(TRAIN_TABLE.to_owned(), TableConfig::default())]),
        }
    }
}

/// How a table draws sequences. A sequence lies within one episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, JsonSchema, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SelectorKind {
    /// Every sequence with the same probability.
    Steps,
    /// Uniform over episodes, then over their sequences: the paper's.
    Episodes,
    /// In proportion to priorities that the learner sets; new sequences take the greatest one.
    Prioritized,
    /// Each sequence once, in the order of arrival.
    Fifo,
    /// A mixture of the newest sequences and all.
    Recent,
}

/// One table.
#[derive(Debug, Clone, PartialEq, JsonSchema, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TableConfig {
    /// How sequences are drawn.
    pub selector: SelectorKind,
    /// Whether draws count against the ratio of `learner.replay_ratio` and wait for it. Draws from other tables
    /// wait only for `learner.prefill_steps`.
    pub limited: bool,
    /// With `episodes`: share of the draws that take an episode's last sequence, from 0 to 1. The last step, which says
    /// whether an episode ends, lies in one sequence alone, others in as many as `learner.batch_length`.
    pub ends_share: f64,
    /// With `prioritized`: the exponent of the priorities, 0 or greater; 0 is uniform.
    pub priority_exponent: f64,
    /// With `recent`: sequences that count as new, at least 1.
    pub newest: u64,
    /// With `recent`: share of the draws that take a new one, from 0 to 1.
    pub newest_share: f64,
}

impl Default for TableConfig {
    fn default() -> Self {
        Self {
            selector: SelectorKind::Episodes,
            limited: true,
            ends_share: 0.0,
            priority_exponent: 0.6,
            newest: 10_000,
            newest_share: 0.5,
        }
    }
}
