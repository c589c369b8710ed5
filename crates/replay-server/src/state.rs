//! What all streams of a server share.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isodream_proto::v1::ReplayStatus;
use isodream_replay::{Draw, LimiterOptions, RateLimiter, Sampler, SequenceRef, Store};
use isodream_rpc::ServiceError;
use tokio::sync::{Notify, mpsc, watch};
use tokio_util::sync::CancellationToken;

use crate::commit::Command;
use crate::tables::Tables;

/// How long a learner may draw: until a newer one comes.
pub(crate) struct Reign {
    epoch: u64,
    newest: watch::Receiver<u64>,
}

impl Reign {
    fn is_over(&self) -> bool {
        self.epoch != 0 && *self.newest.borrow() > self.epoch
    }

    /// Waits for its end, and says why.
    pub(crate) async fn end(mut self) -> ServiceError {
        while !self.is_over() {
            if self.newest.changed().await.is_err() {
                return stopping();
            }
        }
        fenced()
    }
}

fn fenced() -> ServiceError {
    ServiceError::Refused(
        "a newer learner of this run draws from here and has fenced this one off; stop one of them"
            .to_owned(),
    )
}

pub(crate) struct State {
    pub(crate) store: Store,
    store_id: String,
    pub(crate) tables: Tables,
    limiter: Mutex<RateLimiter>,
    /// Wakes every stream that waits for the limiter.
    pub(crate) changed: Notify,
    commands: mpsc::Sender<Command>,
    pub(crate) stop: CancellationToken,
    /// Why the disk takes no chunks at present.
    stall: Mutex<Option<String>>,
    /// The newest learner's of a limited table; none before the first one connects.
    learner: Mutex<Option<Sampler>>,
    /// Epoch of the newest learner whose draws count.
    learner_epoch: watch::Sender<u64>,
}

impl State {
    pub(crate) fn new(
        store: Store,
        store_id: String,
        tables: Tables,
        limiter: LimiterOptions,
        commands: mpsc::Sender<Command>,
        stop: CancellationToken,
    ) -> Self {
        let inserted_steps = store.stats().inserted_steps;
        Self {
            store,
            store_id,
            tables,
            limiter: Mutex::new(RateLimiter::new(limiter, inserted_steps)),
            changed: Notify::new(),
            commands,
            stop,
            stall: Mutex::new(None),
            learner: Mutex::new(None),
            learner_epoch: watch::Sender::new(0),
        }
    }

    /// Refuses, for now, a peer that looks for another store: it asks again who is here.
    pub(crate) fn check_store(&self, wanted: &str) -> Result<(), ServiceError> {
        if wanted.is_empty() || wanted == self.store_id {
            return Ok(());
        }
        Err(ServiceError::Unavailable(format!(
            "this is the store {}, not {wanted}; connect again",
            self.store_id
        )))
    }

    /// Fences off all learners older than this one; 0 stays out of that.
    pub(crate) fn admit_learner(&self, epoch: u64) -> Result<Reign, ServiceError> {
        let reign = Reign {
            epoch,
            newest: self.learner_epoch.subscribe(),
        };
        self.learner_epoch.send_if_modified(|newest| {
            let is_newer = epoch > *newest;
            *newest = epoch.max(*newest);
            is_newer
        });
        match reign.is_over() {
            true => Err(fenced()),
            false => Ok(reign),
        }
    }

    /// Hands a command to the commit thread; waits while its queue is full.
    pub(crate) async fn command(&self, command: Command) -> Result<(), ServiceError> {
        self.commands.send(command).await.map_err(|_| stopping())
    }

    /// Holds all inserts for `why`, or lets them go on.
    pub(crate) fn set_stall(&self, why: Option<String>) {
        *self.stall.lock().unwrap_or_else(PoisonError::into_inner) = why;
        self.changed.notify_waiters();
    }

    fn stall(&self) -> Option<String> {
        let stall = self.stall.lock().unwrap_or_else(PoisonError::into_inner);
        stall.clone()
    }

    /// Admits an insert, or says why it waits.
    pub(crate) fn try_insert(self: &Arc<Self>, steps: u32) -> Result<Admission, String> {
        if let Some(why) = self.stall() {
            return Err(why);
        }
        let can_sample = self.can_sample();
        {
            let mut limiter = self.limiter();
            if let Some(why) = limiter.why_insert_waits(can_sample) {
                return Err(why);
            }
            limiter.insert(u64::from(steps));
        }
        Ok(Admission {
            state: self.clone(),
            steps: u64::from(steps),
        })
    }

    /// Admits a draw and makes it, or says why it waits.
    pub(crate) fn try_draw(
        &self,
        draw: Draw,
        sampler: &mut Sampler,
    ) -> Result<SequenceRef, String> {
        let can_sample = sampler.can_draw();
        let sequence = {
            let mut limiter = self.limiter();
            if let Some(why) = limiter.why_sample_waits(draw, can_sample) {
                return Err(why);
            }
            // Eviction may have come between.
            let Some(sequence) = sampler.draw() else {
                return Err("the table has no sequence to give".to_owned());
            };
            limiter.sample(draw, u64::from(sampler.sequence_length()));
            sequence
        };
        self.changed.notify_waiters();
        Ok(sequence)
    }

    /// Why a draw waits.
    pub(crate) fn why_draw_waits(&self, draw: Draw, sampler: &Sampler) -> Option<String> {
        let can_sample = sampler.can_draw();
        self.limiter().why_sample_waits(draw, can_sample)
    }

    /// Takes back an admitted draw that was not sent.
    pub(crate) fn undo_draw(&self, draw: Draw, sequence_length: u32) {
        self.limiter().undo_sample(draw, u64::from(sequence_length));
        self.changed.notify_waiters();
    }

    /// The learner of a limited table connects: its count and its sequences are what the limiter works with, unless a
    /// newer learner has come.
    pub(crate) fn learner_connected(
        &self,
        epoch: u64,
        sampler: &Sampler,
        sampled_steps: u64,
    ) -> Result<Reign, ServiceError> {
        // Held throughout: a newer one that comes at the same time is admitted before this one, or counts after it.
        let mut learner = self.learner();
        let reign = self.admit_learner(epoch)?;
        *learner = Some(sampler.clone());
        self.limiter().set_sampled(sampled_steps);
        drop(learner);
        self.changed.notify_waiters();
        Ok(reign)
    }

    pub(crate) fn status(&self) -> ReplayStatus {
        let stats = self.store.stats();
        let can_sample = self.can_sample();
        let limiter = self.limiter();
        ReplayStatus {
            steps: stats.steps,
            episodes: stats.episodes,
            bytes: stats.bytes,
            inserted_steps: stats.inserted_steps,
            sampled_steps: limiter.sampled_steps(),
            quarantined_records: stats.quarantined_records,
            priority_updates: stats.priorities.applied,
            ignored_priority_updates: stats.priorities.ignored,
            insert_waiting: self
                .stall()
                .or_else(|| limiter.why_insert_waits(can_sample))
                .unwrap_or_default(),
            sample_waiting: limiter
                .why_sample_waits(Draw::Limited, can_sample)
                .unwrap_or_default(),
            store_id: self.store_id.clone(),
        }
    }

    /// Whether the learner could be served. Before one connects nobody knows its length, and one step will do.
    fn can_sample(&self) -> bool {
        match &*self.learner() {
            Some(sampler) => sampler.can_draw(),
            None => self.store.stats().steps > 0,
        }
    }

    fn learner(&self) -> MutexGuard<'_, Option<Sampler>> {
        self.learner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn limiter(&self) -> MutexGuard<'_, RateLimiter> {
        self.limiter.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Steps that the limiter counts as inserted. Dropped without [`Admission::stored`], wherever a stream or the
/// server was interrupted, it takes them back.
pub(crate) struct Admission {
    state: Arc<State>,
    steps: u64,
}

impl Admission {
    /// The steps are durable and stay counted.
    pub(crate) fn stored(mut self) {
        self.steps = 0;
    }
}

impl Drop for Admission {
    fn drop(&mut self) {
        if self.steps > 0 {
            self.state.limiter().undo_insert(self.steps);
            self.state.changed.notify_waiters();
        }
    }
}

/// The answer to everyone who is served while the server stops.
pub(crate) fn stopping() -> ServiceError {
    ServiceError::Unavailable("the replay-server is shutting down".to_owned())
}
