//! What a [`crate::SampleClient`] knows of its replay-servers, for those who do not hold it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isodream_proto::v1::ReplayStatus;

use crate::RpcError;
use crate::link_state::{Ending, LinkState};

/// A view on a [`crate::SampleClient`], which another thread may hold.
#[derive(Debug, Clone, Default)]
pub struct SampleWatch {
    ending: Arc<Ending>,
    servers: Arc<Mutex<Servers>>,
}

#[derive(Debug, Default)]
struct Servers {
    links: Vec<Arc<LinkState>>,
    inserted_steps: BTreeMap<String, u64>,
}

impl SampleWatch {
    /// Why no sequences arrive, in words; none where they do.
    pub fn waiting(&self) -> Option<String> {
        if let Some(error) = self.ended() {
            return Some(error.to_string());
        }
        let links = self.servers().links.clone();
        let mut reasons = Vec::new();
        for link in &links {
            reasons.push(link.waiting()?);
        }
        if reasons.is_empty() {
            return Some("replay-servers are looked up".to_owned());
        }
        Some(reasons.join("; "))
    }

    /// Steps that went into all stores that were seen since this client started, evicted ones included; at
    /// most a few seconds old.
    pub fn inserted_steps(&self) -> u64 {
        self.servers().inserted_steps.values().sum()
    }

    pub(crate) fn add(&self, link: Arc<LinkState>) {
        self.servers().links.push(link);
    }

    pub(crate) fn remove(&self, link: &Arc<LinkState>) {
        self.servers()
            .links
            .retain(|known| !Arc::ptr_eq(known, link));
    }

    pub(crate) fn holds(&self, status: &ReplayStatus) {
        let mut servers = self.servers();
        let known = servers.inserted_steps.entry(status.store_id.clone());
        *known.or_default() = status.inserted_steps;
    }

    pub(crate) fn end(&self, error: RpcError) {
        self.ending.set(error);
    }

    /// Why the client of `peers` is at its end.
    pub(crate) fn end_of(&self, peers: &str) -> RpcError {
        self.ended().unwrap_or_else(|| RpcError::Closed {
            peer: format!("replay-server {peers}"),
        })
    }

    pub(crate) fn ended(&self) -> Option<RpcError> {
        self.ending.get()
    }

    fn servers(&self) -> MutexGuard<'_, Servers> {
        self.servers.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
