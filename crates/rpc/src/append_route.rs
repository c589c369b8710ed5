//! Which replay-server an [`crate::AppendClient`] sends to.

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use isodream_core::derive_seed;
use tokio::task::JoinSet;

use crate::append_link::{AppendLink, LinkEnd, Purpose, Sender};
use crate::courier::Courier;
use crate::link_state::LinkState;
use crate::spool::Spool;
use crate::{Dialer, RpcError};

/// Sends to one server for as long as it is there, then to the next, for ever.
pub(crate) struct AppendRoute {
    dialer: Dialer,
    addresses: Vec<String>,
    failover_after: Duration,
    sender: Arc<Sender>,
    spool: Arc<Spool>,
    /// The link that new chunks go to.
    current: Arc<Mutex<Arc<LinkState>>>,
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
        }
    }

    /// Returns only when a server refuses for good: one that new chunks go to, or one that was sent some before.
    pub(crate) async fn run(self) -> RpcError {
        tokio::select! {
            error = self.send() => error,
            error = self.deliver_leftovers() => error,
        }
    }

    async fn send(&self) -> RpcError {
        let mut left = None;
        loop {
            let addresses = self.dialer.resolve(&self.addresses).await;
            let address = next(&self.sender.actor_id, addresses.clone(), left.as_deref());
            let patience = (addresses.len() > 1).then_some(self.failover_after);
            match self.send_to(&address, patience).await {
                LinkEnd::Refused(error) => {
                    // Whoever has taken over the address of a server that moved does not speak for it.
                    if self.dialer.leads_to(&self.addresses, &address).await {
                        return error;
                    }
                    tracing::warn!(address, %error, "no replay-server of ours is there any more");
                }
                LinkEnd::Away | LinkEnd::Empty => {
                    tracing::warn!(
                        address,
                        after_secs = self.failover_after.as_secs_f64(),
                        "a replay-server stays away, turning to the next"
                    );
                }
            }
            left = Some(address);
        }
    }

    async fn send_to(&self, address: &str, patience: Option<Duration>) -> LinkEnd {
        let client = match self.dialer.replay(address) {
            Ok(client) => client,
            Err(error) => return LinkEnd::Refused(error),
        };
        let link = AppendLink {
            client,
            sender: self.sender.clone(),
            spool: self.spool.clone(),
            state: Arc::new(LinkState::new(address)),
            purpose: Purpose::Current(patience),
        };
        *self.current.lock().unwrap_or_else(PoisonError::into_inner) = link.state.clone();
        link.run().await
    }

    /// Keeps a courier for every store that is left behind with chunks.
    async fn deliver_leftovers(&self) -> RpcError {
        let mut couriers = JoinSet::new();
        let mut delivering = BTreeSet::new();
        let mut changes = self.spool.changes();
        loop {
            changes.borrow_and_update();
            for store_id in self.spool.left_behind() {
                if delivering.insert(store_id.clone()) {
                    let courier = self.courier(store_id.clone());
                    couriers.spawn(async move { (store_id, courier.run().await) });
                }
            }
            tokio::select! {
                // The spool lives as long as this route.
                _ = changes.changed() => {}
                Some(ended) = couriers.join_next() => match ended {
                    Ok((store_id, Ok(()))) => {
                        delivering.remove(&store_id);
                    }
                    Ok((_, Err(error))) => return error,
                    Err(error) => {
                        tracing::error!(%error, "a courier died");
                        let peer = format!("replay-server {}", self.addresses.join(", "));
                        return RpcError::Closed { peer };
                    }
                },
            }
        }
    }

    fn courier(&self, store_id: String) -> Courier {
        Courier {
            dialer: self.dialer.clone(),
            addresses: self.addresses.clone(),
            sender: self.sender.clone(),
            spool: self.spool.clone(),
            store_id,
        }
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
    use std::collections::BTreeMap;

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
