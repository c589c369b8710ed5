//! What a client knows of its connections, in words.

use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use tokio::time::Instant;

use crate::RpcError;

/// Why a client is at its end: shared by its handle and all its tasks; the first reason stays.
#[derive(Debug, Default)]
pub(crate) struct Ending(OnceLock<RpcError>);

impl Ending {
    pub(crate) fn set(&self, error: RpcError) {
        let _ = self.0.set(error);
    }

    pub(crate) fn get(&self) -> Option<RpcError> {
        self.0.get().cloned()
    }
}

/// One connection, as its task and the client's handle see it.
#[derive(Debug)]
pub(crate) struct LinkState {
    peer: String,
    inner: Mutex<Inner>,
}

#[derive(Debug)]
struct Inner {
    /// None while connected.
    gone_since: Option<Instant>,
    last_error: String,
    /// The peer's own reason to make us wait.
    peer_waits: String,
}

impl LinkState {
    pub(crate) fn new(address: &str) -> Self {
        Self {
            peer: format!("replay-server {address}"),
            inner: Mutex::new(Inner {
                gone_since: Some(Instant::now()),
                last_error: String::new(),
                peer_waits: String::new(),
            }),
        }
    }

    pub(crate) fn connected(&self) {
        let mut inner = self.lock();
        if let Some(since) = inner.gone_since.take() {
            tracing::info!(peer = %self.peer, after_secs = since.elapsed().as_secs_f64(), "connected");
        }
    }

    pub(crate) fn lost(&self, error: String) {
        let mut inner = self.lock();
        inner.peer_waits.clear();
        if inner.gone_since.is_none() || inner.last_error != error {
            tracing::warn!(peer = %self.peer, %error, "connection lost, trying again");
        }
        inner.gone_since.get_or_insert_with(Instant::now);
        inner.last_error = error;
    }

    pub(crate) fn peer_waits(&self, why: &str) {
        let mut inner = self.lock();
        if inner.peer_waits != why {
            inner.peer_waits = why.to_owned();
        }
    }

    pub(crate) fn refused(&self, reason: String) -> RpcError {
        RpcError::Refused {
            peer: self.peer.clone(),
            reason,
        }
    }

    pub(crate) fn waiting(&self) -> Option<String> {
        let inner = self.lock();
        if let Some(since) = inner.gone_since {
            let cause = if inner.last_error.is_empty() {
                String::new()
            } else {
                format!(" ({})", inner.last_error)
            };
            return Some(format!(
                "no working connection to {} for {} s{cause}",
                self.peer,
                since.elapsed().as_secs()
            ));
        }
        (!inner.peer_waits.is_empty()).then(|| inner.peer_waits.clone())
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
