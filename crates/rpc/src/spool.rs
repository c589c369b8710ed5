//! Chunks that were handed over but are not durable yet.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use isodream_core::Chunk;
use tokio::sync::{Notify, Semaphore};

/// A bounded queue, numbered from 0; what is acknowledged leaves it at the front.
#[derive(Debug)]
pub(crate) struct Spool {
    chunks: Mutex<Numbered>,
    room: Semaphore,
    /// Wakes the sender's task after a push, and waiting flushes after an acknowledgement.
    pub(crate) pushed: Notify,
    pub(crate) acknowledged: Notify,
}

#[derive(Debug, Default)]
struct Numbered {
    waiting: VecDeque<Chunk>,
    next_seq: u64,
}

impl Spool {
    pub(crate) fn new(capacity: usize) -> Self {
        Self {
            chunks: Mutex::default(),
            room: Semaphore::new(capacity.max(1)),
            pushed: Notify::new(),
            acknowledged: Notify::new(),
        }
    }

    /// Numbers `chunk` and queues it once there is room. False where the spool is closed.
    pub(crate) async fn push(&self, mut chunk: Chunk) -> bool {
        let Ok(permit) = self.room.acquire().await else {
            return false;
        };
        permit.forget();
        {
            let mut chunks = self.lock();
            chunk.seq = chunks.next_seq;
            chunks.next_seq += 1;
            chunks.waiting.push_back(chunk);
        }
        self.pushed.notify_one();
        true
    }

    /// The chunk numbered `seq`, if it was pushed and is not acknowledged.
    pub(crate) fn get(&self, seq: u64) -> Option<Chunk> {
        let chunks = self.lock();
        let index = seq.checked_sub(chunks.first_seq())?;
        chunks.waiting.get(usize::try_from(index).ok()?).cloned()
    }

    /// Drops everything below `durable_seq`.
    pub(crate) fn acknowledge(&self, durable_seq: u64) {
        let mut chunks = self.lock();
        let count = durable_seq
            .saturating_sub(chunks.first_seq())
            .min(chunks.waiting.len() as u64) as usize;
        chunks.waiting.drain(..count);
        drop(chunks);
        if count > 0 {
            self.room.add_permits(count);
            self.acknowledged.notify_waiters();
        }
    }

    /// Everything below it was acknowledged.
    pub(crate) fn acknowledged_seq(&self) -> u64 {
        self.lock().first_seq()
    }

    pub(crate) fn len(&self) -> usize {
        self.lock().waiting.len()
    }

    /// Wakes and refuses everyone who waits for room; what is queued stays.
    pub(crate) fn close(&self) {
        self.room.close();
        self.acknowledged.notify_waiters();
    }

    fn lock(&self) -> MutexGuard<'_, Numbered> {
        self.chunks.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Numbered {
    fn first_seq(&self) -> u64 {
        self.next_seq - self.waiting.len() as u64
    }
}
