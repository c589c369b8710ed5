//! The writing half of a store: one per folder.

use std::time::{SystemTime, UNIX_EPOCH};

use isodream_core::Chunk;

use crate::ledger::{Ledger, Outcome};
use crate::log::SegmentLog;
use crate::record::{self, Record, Snapshot};
use crate::{Capacity, Progress, ReplayError, Store, StoreIdentity};

/// Writes to a store and owns its folder's lock. Every method blocks on the disk: give it a thread of its own.
#[derive(Debug)]
pub struct StoreWriter {
    log: SegmentLog,
    ledger: Ledger,
    store: Store,
    capacity: Capacity,
}

impl StoreWriter {
    pub(crate) fn new(log: SegmentLog, ledger: Ledger, store: Store, capacity: Capacity) -> Self {
        Self {
            log,
            ledger,
            store,
            capacity,
        }
    }

    /// Names the store for as long as it exists: kept in its folder, drawn when that was made.
    pub fn store_id(&self) -> &str {
        self.log.folder().id()
    }

    /// What the store belongs to: the first identity ever offered, kept durably.
    ///
    /// # Errors
    /// [`ReplayError`] where the identity file cannot be read or written.
    pub fn adopt_identity(
        &mut self,
        offered: &StoreIdentity,
    ) -> Result<StoreIdentity, ReplayError> {
        if let Some(stored) = self.log.folder().identity()? {
            return Ok(stored);
        }
        self.log.folder().set_identity(offered)?;
        Ok(offered.clone())
    }

    /// The epoch of an actor's process: `claimed`, what another store gave it, or where that is 0 a new one, greater
    /// than any that this store knows of the actor, and by the machine's clock (microseconds since 1970), so that
    /// epochs of several stores tell the older process too. The same `process` gets the same epoch until another one
    /// comes. [`StoreWriter::begin`] makes it durable.
    ///
    /// # Errors
    /// [`ReplayError::InvalidChunk`] for an actor id or an epoch that cannot be stored.
    pub fn epoch_for(
        &mut self,
        actor_id: &str,
        process: u64,
        claimed: u64,
    ) -> Result<u64, ReplayError> {
        record::check_position(actor_id, claimed, 0)?;
        let now = SystemTime::now().duration_since(UNIX_EPOCH);
        let micros = now.map_or(0, |now| now.as_micros() as u64);
        Ok(self
            .ledger
            .epoch_for(actor_id, process, claimed, micros.max(1)))
    }

    /// An actor connects: fences off its older epochs, durably. Returns the sequence number it has to send
    /// next.
    ///
    /// `acknowledged_seq` is what the actor was promised so far (0 at first): where the store lost those
    /// records, for example to a reset, it moves on with the actor.
    ///
    /// # Errors
    /// [`ReplayError::Fenced`] for an older epoch, [`ReplayError::InvalidChunk`] for an actor id or a number that
    /// cannot be stored, else the errors of [`SegmentLog::append`] and [`SegmentLog::sync`].
    pub fn begin(
        &mut self,
        actor_id: &str,
        epoch: u64,
        acknowledged_seq: u64,
    ) -> Result<u64, ReplayError> {
        record::check_position(actor_id, epoch, acknowledged_seq)?;
        let (next_seq, is_news) = self.ledger.begin(actor_id, epoch, acknowledged_seq)?;
        if is_news {
            let progress = Progress {
                actor_id: actor_id.to_owned(),
                epoch,
                next_seq,
            };
            self.write(&[Record::Progress(progress)])?;
        }
        self.ledger.keep();
        Ok(next_seq)
    }

    /// Stores a group of chunks with one sync. What became of each is answered in order; every
    /// [`Outcome::Stored`] survived `fdatasync` and can be sampled.
    ///
    /// # Errors
    /// Nothing of the group was kept. [`ReplayError::is_fatal`] tells whether the writer is at its end.
    pub fn commit(&mut self, chunks: Vec<Chunk>) -> Result<Vec<Outcome>, ReplayError> {
        let mut outcomes = Vec::with_capacity(chunks.len());
        let mut records = Vec::with_capacity(chunks.len());
        for chunk in chunks {
            let outcome = match record::check(&chunk) {
                Ok(()) => self.ledger.admit(&chunk),
                Err(error) => Outcome::Invalid {
                    reason: error.to_string(),
                },
            };
            if matches!(outcome, Outcome::Stored { .. }) {
                records.push(Record::Chunk(chunk));
            }
            outcomes.push(outcome);
        }
        if !records.is_empty() {
            let written = self.write(&records);
            // Also after a failure: a full disk may hold segments that could not be deleted before.
            self.evict();
            written?;
        }
        Ok(outcomes)
    }

    /// Writes, syncs and only then indexes; takes back what the ledger was told where that fails.
    fn write(&mut self, records: &[Record]) -> Result<(), ReplayError> {
        let inserted_steps = self.store.lock().inserted_steps;
        let snapshot = || Snapshot {
            inserted_steps,
            progress: self.ledger.durable_progress(),
            ..Snapshot::default()
        };
        let durable = match self.log.append(records, snapshot) {
            Ok(appended) => self.log.sync().map(|_| appended.chunks),
            Err(error) => Err(error),
        };
        let places = match durable {
            Ok(places) => places,
            Err(error) => {
                self.ledger.roll_back();
                return Err(error);
            }
        };
        self.ledger.keep();
        let chunks = records.iter().filter_map(|record| match record {
            Record::Chunk(chunk) => Some(chunk),
            Record::Snapshot(_) | Record::Progress(_) => None,
        });
        let mut held = self.store.lock();
        for (chunk, place) in chunks.zip(places) {
            held.inserted_steps += u64::from(chunk.steps);
            held.insert(chunk.episode_id, chunk.ends_episode, place);
        }
        Ok(())
    }

    /// Evicts down to the capacity and deletes the segments that nobody needs.
    pub(crate) fn evict(&mut self) {
        let evicted = self.store.lock().evict(self.capacity);
        let store = &self.store;
        match self
            .log
            .delete_segments(|number| store.lock().index.is_live(number))
        {
            Ok(0) if evicted == 0 => {}
            Ok(segments) => tracing::debug!(evicted, segments, "evicted the oldest episodes"),
            // Tried again at the next eviction; until then the segment only takes space.
            Err(error) => tracing::warn!(%error, "cannot delete an evicted replay segment"),
        }
    }
}
