//! The shared half of a store: what is held, sampled by many.

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rand_chacha::ChaCha8Rng;

use crate::folder::Folder;
use crate::index::Index;
use crate::ledger::Ledger;
use crate::log::SegmentLog;
use crate::recover::Recovered;
use crate::writer::StoreWriter;
use crate::{ChunkRef, Quarantined, ReplayError, SequenceRef};

/// Settings of a store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoreOptions {
    /// Steps held at most; beyond it the oldest episodes are evicted. The newest episode always stays.
    pub capacity_steps: u64,
    /// Size in bytes at which a segment is closed and the next begins. Disk space is freed in whole
    /// segments, one file descriptor is held per segment, and opening reads one segment at a time into memory.
    pub segment_bytes: u64,
}

impl Default for StoreOptions {
    fn default() -> Self {
        Self {
            capacity_steps: 1_000_000,
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
}

#[derive(Debug)]
pub(crate) struct Held {
    pub(crate) index: Index,
    pub(crate) inserted_steps: u64,
    quarantined: Vec<Quarantined>,
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
        let mut index = Index::default();
        let mut ledger = Ledger::default();
        let mut inserted_steps = 0;
        let mut chunks = 0;
        let (log, found) = SegmentLog::open_with(
            Folder::open(folder)?,
            options.segment_bytes,
            &mut |record| match record {
                Recovered::Chunk(chunk, place) => {
                    chunks += 1;
                    inserted_steps += u64::from(chunk.steps);
                    ledger.recover(&chunk.actor_id, chunk.epoch, chunk.seq.saturating_add(1));
                    index.insert(chunk.episode_id, chunk.ends_episode, place);
                }
                Recovered::Snapshot(snapshot) => {
                    inserted_steps = snapshot.inserted_steps.max(inserted_steps);
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
        let store = Self {
            held: Arc::new(Mutex::new(Held {
                index,
                inserted_steps,
                quarantined: found.quarantined,
            })),
        };
        let mut writer = StoreWriter::new(log, ledger, store.clone(), options.capacity_steps);
        writer.evict();
        Ok((writer, store, recovery))
    }

    pub(crate) fn lock(&self) -> MutexGuard<'_, Held> {
        // No panic can leave the index half changed: its methods do not call out.
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn sample(&self, length: u32, rng: &mut ChaCha8Rng) -> Option<SequenceRef> {
        self.lock().index.sample(length, rng)
    }

    /// Whether some episode holds `sequence_length` durable steps.
    pub fn can_sample(&self, sequence_length: u32) -> bool {
        self.lock().index.can_sample(sequence_length)
    }

    /// Takes a chunk that cannot be read out of the store, counted and listed.
    pub fn quarantine(&self, chunk: &ChunkRef, reason: &'static str) {
        let mut held = self.lock();
        if held.index.remove(chunk) {
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
        }
    }
}
