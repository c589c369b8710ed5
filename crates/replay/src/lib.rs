//! Durable experience storage: segment log, index, sequence sampler, rate limiter.
//!
//! A library without a network and without an async runtime. [`Store::open`] gives two halves:
//! - [`StoreWriter`], one per folder, which judges chunks (exactly once, epoch fencing), writes a group of
//!   them, makes it durable with one `fdatasync` and only then lets the index know;
//! - [`Store`], cloned freely, from which a [`Sampler`] of a [`Table`] draws sequences. Reads take no lock.
//!
//! The [`RateLimiter`] is pure accounting beside them.
//!
//! # What survives what
//! A chunk that [`StoreWriter::commit`] reported as stored survives a crash of process or machine. It
//! disappears in three ways only: eviction by [`StoreOptions::capacity`], removal of the folder, or a
//! damaged record, which is skipped, counted and listed ([`Quarantined`]): a damaged header when the store is
//! opened, a damaged payload when it is read.

mod capacity;
mod contents;
mod error;
mod failpoint;
mod folder;
mod index;
mod inspect;
mod ledger;
mod limiter;
mod log;
mod record;
mod recover;
mod sampler;
mod scan;
mod segment;
mod selector;
mod store;
mod table;
mod writer;

pub use capacity::Capacity;
pub use contents::{find_chunk, for_each_chunk};
pub use error::ReplayError;
pub use folder::StoreIdentity;
pub use index::{
    Index, IndexStats, IndexedChunk, PriorityCounts, PriorityUpdate, Sequence, ViewHandle,
};
pub use inspect::{EpisodeSummary, Inspection, SegmentSummary, Verification, inspect, verify};
pub use ledger::{Outcome, Progress};
pub use limiter::{Draw, LimiterOptions, RateLimiter};
pub use log::{Appended, DurablePosition, LogPosition, SegmentLog, WrittenPosition};
pub use record::{MAX_ACTOR_ID_BYTES, MAX_PAYLOAD_BYTES, Record, Snapshot};
pub use recover::LogRecovery;
pub use sampler::{Sampler, SequenceRef};
pub use scan::Quarantined;
pub use segment::ChunkRef;
pub use selector::Selector;
pub use store::{Recovery, Store, StoreOptions, StoreStats};
pub use table::Table;
pub use writer::StoreWriter;
