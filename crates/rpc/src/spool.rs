//! Chunks that were handed over but are not durable yet.
//!
//! A chunk belongs to no store until it is handed to the transport of one, which numbers it. From then on
//! nobody can tell whether that store has it until it answers, so the chunk waits for this store and is never
//! sent to another: what keeps a step from being stored twice.

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Debug;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use isodream_core::Chunk;
use tokio::sync::watch;

/// Learns of chunks that became durable.
pub trait AcknowledgedChunks: Debug + Send + Sync {
    /// The store `store_id` has `chunk`. Called before the chunk is dropped, in the order of each store; it must
    /// not wait for long, because everything else of the client waits for it.
    fn acknowledged(&self, store_id: &str, chunk: &Chunk);
}

/// How much a spool holds at most before its producer waits, and again for stores that are away.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bounds {
    pub(crate) chunks: usize,
    pub(crate) bytes: usize,
}

/// A bounded queue in front of one outbox per store.
#[derive(Debug)]
pub(crate) struct Spool {
    bounds: Bounds,
    inner: Mutex<Inner>,
    observer: OnceLock<Arc<dyn AcknowledgedChunks>>,
    /// Tells everyone who waits that something changed.
    changes: watch::Sender<()>,
}

#[derive(Debug, Default)]
struct Inner {
    unsent: VecDeque<Chunk>,
    outboxes: BTreeMap<String, Outbox>,
    /// The store that new chunks go to; empty before the first one answers.
    current: String,
    /// How often the client turned to another store.
    turns: u64,
    acknowledged: u64,
    given_up: usize,
    closed: bool,
}

/// What one store was sent and has not acknowledged, numbered from 0.
#[derive(Debug, Default)]
struct Outbox {
    chunks: VecDeque<Chunk>,
    next_seq: u64,
    /// By which the store knows the sender; 0 before it answers.
    epoch: u64,
    /// The turn in which the client left the store last.
    left: u64,
}

impl Outbox {
    fn first_seq(&self) -> u64 {
        self.next_seq - self.chunks.len() as u64
    }
}

impl Spool {
    pub(crate) fn new(bounds: Bounds) -> Self {
        Self {
            bounds,
            inner: Mutex::default(),
            observer: OnceLock::new(),
            changes: watch::Sender::new(()),
        }
    }

    /// Tells `observer` of every chunk that is acknowledged from now on. Only the first one counts.
    pub(crate) fn observe(&self, observer: Arc<dyn AcknowledgedChunks>) {
        let _ = self.observer.set(observer);
    }

    /// Tells about every change from now on.
    pub(crate) fn changes(&self) -> watch::Receiver<()> {
        self.changes.subscribe()
    }

    /// Queues `chunk` once there is room. False where the spool is closed.
    pub(crate) async fn push(&self, chunk: Chunk) -> bool {
        let mut changes = self.changes();
        loop {
            changes.borrow_and_update();
            {
                let mut inner = self.lock();
                if inner.closed {
                    return false;
                }
                if inner.has_room(self.bounds, chunk.payload.len()) {
                    inner.unsent.push_back(chunk);
                    break;
                }
            }
            // The sender lives as long as this spool.
            let _ = changes.changed().await;
        }
        self.changes.send_replace(());
        true
    }

    /// New chunks go to `store` from now on. Chunks of other stores stay within the bounds: beyond them those of the
    /// store that was left first are given up. Returns how many were.
    pub(crate) fn turn_to(&self, store: &str) -> usize {
        let mut guard = self.lock();
        let inner = &mut *guard;
        if inner.current == store {
            return 0;
        }
        inner.turns += 1;
        if let Some(outbox) = inner.outboxes.get_mut(&inner.current) {
            outbox.left = inner.turns;
        }
        store.clone_into(&mut inner.current);
        let given_up = inner.give_up_beyond(self.bounds);
        inner.given_up += given_up;
        drop(guard);
        // What waits for the store before does not take up room any more.
        self.changes.send_replace(());
        given_up
    }

    /// `store` answered, and knows the sender by `epoch`.
    pub(crate) fn begin(&self, store: &str, epoch: u64) {
        let mut inner = self.lock();
        inner.outboxes.entry(store.to_owned()).or_default().epoch = epoch;
    }

    /// The epoch by which `store` knows the sender, if it ever answered.
    pub(crate) fn epoch(&self, store: &str) -> Option<u64> {
        let inner = self.lock();
        let outbox = inner.outboxes.get(store)?;
        (outbox.epoch != 0).then_some(outbox.epoch)
    }

    /// Chunk `seq` of `store`, if it is not acknowledged. With `take`, the next one that was not sent anywhere
    /// becomes the store's where it is the one asked for.
    pub(crate) fn get(&self, store: &str, seq: u64, take: bool) -> Option<Chunk> {
        let mut guard = self.lock();
        let inner = &mut *guard;
        let outbox = inner.outboxes.entry(store.to_owned()).or_default();
        let index = seq.checked_sub(outbox.first_seq())?;
        if take
            && seq == outbox.next_seq
            && let Some(mut chunk) = inner.unsent.pop_front()
        {
            (chunk.epoch, chunk.seq) = (outbox.epoch, seq);
            outbox.next_seq += 1;
            outbox.chunks.push_back(chunk);
        }
        outbox.chunks.get(usize::try_from(index).ok()?).cloned()
    }

    /// Drops everything of `store` below `durable_seq`.
    ///
    /// # Errors
    /// Where the store has more than it was sent.
    pub(crate) fn acknowledge(&self, store: &str, durable_seq: u64) -> Result<(), String> {
        let mut inner = self.lock();
        let outbox = inner.outboxes.entry(store.to_owned()).or_default();
        if durable_seq > outbox.next_seq {
            return Err(format!(
                "the server has {durable_seq} chunks of this actor, which sent {}: another process uses its id; stop one of them",
                outbox.next_seq
            ));
        }
        let count = durable_seq.saturating_sub(outbox.first_seq());
        for chunk in outbox.chunks.drain(..count as usize) {
            if let Some(observer) = self.observer.get() {
                observer.acknowledged(store, &chunk);
            }
        }
        inner.acknowledged += count;
        drop(inner);
        if count > 0 {
            self.changes.send_replace(());
        }
        Ok(())
    }

    /// Everything of `store` below it was acknowledged (or given up).
    pub(crate) fn first_seq(&self, store: &str) -> u64 {
        self.lock().outboxes.get(store).map_or(0, Outbox::first_seq)
    }

    /// The stores that were left and have not acknowledged all that they were sent.
    pub(crate) fn left_behind(&self) -> Vec<String> {
        let inner = self.lock();
        let left = inner.left_behind();
        left.map(|(store, _)| store.clone()).collect()
    }

    /// Whether `store` is one of [`Spool::left_behind`].
    pub(crate) fn is_left_behind(&self, store: &str) -> bool {
        let inner = self.lock();
        inner.left_behind().any(|(left, _)| left == store)
    }

    /// Chunks that were acknowledged.
    pub(crate) fn acknowledged(&self) -> u64 {
        self.lock().acknowledged
    }

    /// Chunks that were given up: whether they are durable is not known.
    pub(crate) fn given_up(&self) -> usize {
        self.lock().given_up
    }

    pub(crate) fn len(&self) -> usize {
        let inner = self.lock();
        let sent: usize = inner
            .outboxes
            .values()
            .map(|outbox| outbox.chunks.len())
            .sum();
        inner.unsent.len() + sent
    }

    /// Waits until it is closed.
    pub(crate) async fn closed(&self) {
        let mut changes = self.changes();
        while !self.lock().closed {
            // The sender lives as long as this spool.
            let _ = changes.changed().await;
        }
    }

    /// Refuses everyone who waits for room; what is queued stays.
    pub(crate) fn close(&self) {
        self.lock().closed = true;
        self.changes.send_replace(());
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    /// Whether a chunk of `bytes` fits; one always does where there is nothing.
    fn has_room(&self, bounds: Bounds, bytes: usize) -> bool {
        let sent = self.outboxes.get(&self.current);
        let held = self
            .unsent
            .iter()
            .chain(sent.iter().flat_map(|outbox| &outbox.chunks));
        let (chunks, held_bytes) = size(held);
        chunks == 0 || (chunks < bounds.chunks && held_bytes + bytes <= bounds.bytes)
    }

    fn left_behind(&self) -> impl Iterator<Item = (&String, &Outbox)> {
        let stores = self.outboxes.iter();
        stores.filter(|(store, outbox)| **store != self.current && !outbox.chunks.is_empty())
    }

    fn give_up_beyond(&mut self, bounds: Bounds) -> usize {
        let mut given_up = 0;
        loop {
            let (chunks, bytes) = size(self.left_behind().flat_map(|(_, outbox)| &outbox.chunks));
            if chunks <= bounds.chunks.max(1) && (bytes <= bounds.bytes || chunks <= 1) {
                return given_up;
            }
            let first_left = self.left_behind().min_by_key(|(_, outbox)| outbox.left);
            let store = first_left
                .map(|(store, _)| store.clone())
                .unwrap_or_default();
            let outbox = self.outboxes.get_mut(&store);
            given_up +=
                usize::from(outbox.is_some_and(|outbox| outbox.chunks.pop_front().is_some()));
        }
    }
}

/// Chunks and payload bytes.
fn size<'a>(chunks: impl Iterator<Item = &'a Chunk>) -> (usize, usize) {
    chunks.fold((0, 0), |(count, bytes), chunk| {
        (count + 1, bytes + chunk.payload.len())
    })
}

#[cfg(test)]
#[path = "spool_tests.rs"]
mod tests;
