//! Which replay-server an [`crate::AppendClient`] sends to.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use isodream_core::derive_seed;
use tokio::task::{AbortHandle, JoinSet};

use crate::append_link::{AppendLink, LinkEnd, Purpose, Sender};
use crate::link_state::LinkState;
use crate::spool::Spool;
use crate::{Dialer, RpcError};

/// Sends to one server for as long as it is there, then to the next, for ever.
pub(crate) struct AppendRoute {
    pub(crate) dialer: Dialer,
    pub(crate) addresses: Vec<String>,
    pub(crate) failover_after: Duration,
    pub(crate) sender: Arc<Sender>,
    pub(crate) spool: Arc<Spool>,
    /// The link that new chunks go to.
    pub(crate) current: Arc<Mutex<Arc<LinkState>>>,
    /// The stores that addresses led to, as far as they are known.
    stores: BTreeMap<String, String>,
    /// What servers took with them when they went away, one task each, by address.
    leftovers: JoinSet<LinkEnd>,
    delivering: BTreeMap<String, AbortHandle>,
}

impl AppendRoute {
    pub(crate) fn new(
        dialer: Dialer,
        addresses: Vec<String>,
        failover_after: Duration,
        sender: Sender,
        spool: Arc<Spool>,
        current: Arc<Mutex<Arc<LinkState>>>,
    ) -> Self {
        Self {
            dialer,
            addresses,
            failover_after,
            sender: Arc::new(sender),
            spool,
            current,
            stores: BTreeMap::new(),
            leftovers: JoinSet::new(),
            delivering: BTreeMap::new(),
        }
    }

    /// Returns only when a server refuses for good.
    pub(crate) async fn run(mut self) -> RpcError {
        let mut left = None;
        loop {
            let addresses = self.dialer.resolve(&self.addresses).await;
            let address = next(&self.sender.actor_id, addresses.clone(), left.as_deref());
            let patience = (addresses.len() > 1).then_some(self.failover_after);
            match self.send_to(&address, patience).await {
                LinkEnd::Refused(error) => return error,
                LinkEnd::Away | LinkEnd::Empty => {
                    tracing::warn!(
                        address,
                        after_secs = self.failover_after.as_secs_f64(),
                        "a replay-server stays away, turning to the next"
                    );
                    left = Some(address);
                }
            }
        }
    }

    async fn send_to(&mut self, address: &str, patience: Option<Duration>) -> LinkEnd {
        if let Some(task) = self.delivering.remove(address) {
            task.abort();
        }
        let mut link = match self.link(address, Purpose::Current(patience)) {
            Ok(link) => link,
            Err(error) => return LinkEnd::Refused(error),
        };
        *self.current.lock().unwrap_or_else(PoisonError::into_inner) = link.state.clone();
        // A server that refuses what it was sent before refuses this client.
        let refused = async {
            loop {
                match self.leftovers.join_next().await {
                    Some(Ok(LinkEnd::Refused(error))) => return LinkEnd::Refused(error),
                    Some(_) => {}
                    None => std::future::pending().await,
                }
            }
        };
        let end = tokio::select! {
            end = link.run() => end,
            end = refused => end,
        };
        if let Some(store_id) = link.store_id {
            self.stores.insert(address.to_owned(), store_id);
        }
        self.deliver_leftovers(address);
        end
    }

    /// Whatever the store behind `address` was sent waits there for it.
    fn deliver_leftovers(&mut self, address: &str) {
        let Some(store_id) = self.stores.get(address).cloned() else {
            return;
        };
        if !self.spool.owes(&store_id) {
            return;
        }
        if let Ok(mut link) = self.link(address, Purpose::Leftovers(store_id)) {
            let task = self.leftovers.spawn(async move { link.run().await });
            self.delivering.insert(address.to_owned(), task);
        }
    }

    fn link(&self, address: &str, purpose: Purpose) -> Result<AppendLink, RpcError> {
        Ok(AppendLink {
            client: self.dialer.replay(address)?,
            sender: self.sender.clone(),
            spool: self.spool.clone(),
            state: Arc::new(LinkState::new(address)),
            purpose,
            store_id: None,
        })
    }
}

/// The server that comes after `left` in the actor's own order, which a new server changes for few actors
/// (highest random weight), or the first.
fn next(actor_id: &str, mut addresses: Vec<String>, left: Option<&str>) -> String {
    addresses.sort_by_key(|address| Reverse(derive_seed(0, &["shard", actor_id, address])));
    let after = left
        .and_then(|left| addresses.iter().position(|address| address == left))
        .map_or(0, |at| (at + 1) % addresses.len());
    addresses.swap_remove(after)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn actors_spread_over_servers_visit_all_and_few_move_for_a_new_one() {
        let servers: Vec<String> = (0..4).map(|n| format!("replay-{n}:7001")).collect();
        let home = |actor: usize, count: usize| {
            next(&format!("actor-{actor}"), servers[..count].to_vec(), None)
        };
        let mut per_server = BTreeMap::<_, u32>::new();
        let mut moved = 0;
        for actor in 0..400 {
            *per_server.entry(home(actor, 4)).or_default() += 1;
            moved += u32::from(home(actor, 3) != home(actor, 4));
        }
        assert!(
            per_server.values().all(|n| (70..=130).contains(n)),
            "{per_server:?}"
        );
        assert_eq!(Some(&moved), per_server.get("replay-3:7001"), "others stay");

        let mut visited = vec![home(0, 4)];
        for _ in 0..3 {
            let left = visited.last().map(String::as_str);
            visited.push(next("actor-0", servers.clone(), left));
        }
        visited.sort();
        assert_eq!(visited, servers);
    }
}
