//! The shared half of a store: what is held, sampled by many.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isodream_core::EpisodeId;

use crate::folder::Folder;
use crate::index::{Index, IndexedChunk, PriorityCounts};
use crate::ledger::Ledger;
use crate::log::SegmentLog;
use crate::recover::Recovered;
use crate::segment::Segment;
use crate::writer::StoreWriter;
use crate::{Capacity, ChunkRef, Quarantined, ReplayError, Sampler, Table};

/// Settings of a store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoreOptions {
    /// What is kept.
    pub capacity: Capacity,
    /// Size in bytes at which a segment is closed and the next begins. Disk space is freed in whole
    /// segments, one file descriptor is held per segment, and opening reads one segment at a time into memory.
    pub segment_bytes: u64,
}

impl Default for StoreOptions {
    fn default() -> Self {
        Self {
            capacity: Capacity::steps(1_000_000),
            segment_bytes: 128 << 20,
        }
    }
}

/// What opening a store found.
#[derive(Debug, Default)]
pub struct Recovery {
    /// Segments read.
    pub segments: usize,
    /// Chunks found.
    pub chunks: u64,
    /// Bytes of an interrupted write, cut from the end.
    pub torn_bytes: u64,
    /// Damaged stretches that were skipped.
    pub quarantined: Vec<Quarantined>,
}

/// What a store holds and what went through it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoreStats {
    /// Steps held.
    pub steps: u64,
    /// Episodes held, unfinished ones included.
    pub episodes: u64,
    /// Bytes of the records held.
    pub bytes: u64,
    /// Steps inserted since the store was made; never falls, also over restarts and evictions.
    pub inserted_steps: u64,
    /// Damaged stretches met since the process started.
    pub quarantined_records: u64,
    /// Priority updates since the process started.
    pub priorities: PriorityCounts,
}

#[derive(Debug, Default)]
pub(crate) struct Held {
    pub(crate) index: Index,
    /// The segments in which some chunk is held.
    segments: BTreeMap<u64, Arc<Segment>>,
    pub(crate) inserted_steps: u64,
    quarantined: Vec<Quarantined>,
    pub(crate) priorities: PriorityCounts,
}

impl Held {
    pub(crate) fn insert(&mut self, episode_id: EpisodeId, ends_episode: bool, place: ChunkRef) {
        let chunk = IndexedChunk {
            segment: place.segment.number,
            offset: place.offset,
            bytes: place.frame_bytes,
            first_step: place.first_step,
            steps: place.steps,
        };
        self.segments.entry(chunk.segment).or_insert(place.segment);
        self.index.insert(episode_id, ends_episode, chunk);
    }

    pub(crate) fn evict(&mut self, capacity: Capacity) -> u64 {
        let evicted = self.index.evict(capacity);
        self.release_segments();
        evicted
    }

    fn release_segments(&mut self) {
        let index = &self.index;
        self.segments.retain(|number, _| index.is_live(*number));
    }

    /// Where a held chunk lies.
    pub(crate) fn place(&self, chunk: &IndexedChunk) -> Option<ChunkRef> {
        Some(ChunkRef {
            segment: self.segments.get(&chunk.segment)?.clone(),
            offset: chunk.offset,
            frame_bytes: chunk.bytes,
            first_step: chunk.first_step,
            steps: chunk.steps,
        })
    }
}

/// A handle on what a store holds; clones share it.
#[derive(Debug, Clone)]
pub struct Store {
    held: Arc<Mutex<Held>>,
}

impl Store {
    /// Opens or makes the store in `folder`. The writer holds the folder's lock.
    ///
    /// Chunks that were evicted but lie in a segment that is still needed come back as the oldest ones until
    /// the next eviction.
    ///
    /// # Errors
    /// [`ReplayError`] where the folder is in use, has another format or cannot be read. Damaged records are
    /// no error: they are skipped, logged and listed.
    pub fn open(
        folder: &Path,
        options: &StoreOptions,
    ) -> Result<(StoreWriter, Self, Recovery), ReplayError> {
        let mut held = Held::default();
        let mut ledger = Ledger::default();
        let mut chunks = 0;
        let (log, found) = SegmentLog::open_with(
            Folder::open(folder)?,
            options.segment_bytes,
            &mut |record| match record {
                Recovered::Chunk(chunk, place) => {
                    chunks += 1;
                    held.inserted_steps += u64::from(chunk.steps);
                    ledger.recover(&chunk.actor_id, chunk.epoch, chunk.seq.saturating_add(1));
                    held.insert(chunk.episode_id, chunk.ends_episode, place);
                }
                Recovered::Snapshot(snapshot) => {
                    held.inserted_steps = snapshot.inserted_steps.max(held.inserted_steps);
                    for position in &snapshot.progress {
                        ledger.recover(&position.actor_id, position.epoch, position.next_seq);
                    }
                }
                Recovered::Progress(position) => {
                    ledger.recover(&position.actor_id, position.epoch, position.next_seq);
                }
            },
        )?;
        for damage in &found.quarantined {
            tracing::warn!(
                segment = %damage.segment.display(),
                offset = damage.offset,
                bytes = damage.bytes,
                reason = damage.reason,
                "skipped a damaged replay record"
            );
        }
        if found.torn_bytes > 0 {
            tracing::warn!(
                bytes = found.torn_bytes,
                "cut an interrupted write from the replay log"
            );
        }
        let recovery = Recovery {
            segments: found.segments,
            chunks,
            torn_bytes: found.torn_bytes,
            quarantined: found.quarantined.clone(),
        };
        held.quarantined = found.quarantined;
        let store = Self {
            held: Arc::new(Mutex::new(held)),
        };
        let mut writer = StoreWriter::new(log, ledger, store.clone(), options.capacity);
        writer.evict();
        Ok((writer, store, recovery))
    }

    pub(crate) fn lock(&self) -> MutexGuard<'_, Held> {
        // No panic can leave the index half changed: its methods do not call out.
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A sampler of sequences of `sequence_length` steps from `table`. Samplers of equal tables and lengths
    /// share priorities and places in the queue. The first one of a kind takes time in proportion to what is
    /// held.
    ///
    /// The same seed draws the same sequences from a store with the same history.
    ///
    /// # Errors
    /// [`ReplayError::InvalidTable`] where a setting of the table is out of range or the length is 0.
    pub fn sampler(
        &self,
        table: &Table,
        sequence_length: u32,
        seed: u64,
    ) -> Result<Sampler, ReplayError> {
        table.check()?;
        if sequence_length == 0 {
            return Err(ReplayError::InvalidTable {
                table: table.name.clone(),
                reason: "the sequence length is 0",
            });
        }
        let view = self.lock().index.view(table, sequence_length);
        Ok(Sampler::new(self.clone(), table.clone(), view, seed))
    }

    /// Takes a chunk that cannot be read out of the store, counted and listed.
    pub fn quarantine(&self, chunk: &ChunkRef, reason: &'static str) {
        let mut held = self.lock();
        if held.index.remove(chunk.segment.number, chunk.offset) {
            held.release_segments();
            held.quarantined.push(Quarantined {
                segment: chunk.segment.path.clone(),
                offset: chunk.offset,
                bytes: chunk.stored_bytes(),
                reason,
            });
        }
    }

    /// The damaged stretches met since the process started.
    pub fn quarantined(&self) -> Vec<Quarantined> {
        self.lock().quarantined.clone()
    }

    /// What is held now.
    pub fn stats(&self) -> StoreStats {
        let held = self.lock();
        let index = held.index.stats();
        StoreStats {
            steps: index.steps,
            episodes: index.episodes,
            bytes: index.bytes,
            inserted_steps: held.inserted_steps,
            quarantined_records: held.quarantined.len() as u64,
            priorities: held.priorities,
        }
    }
}
