//! The task behind a [`crate::SampleClient`]: one stream of sequences out of all replay-servers.
//!
//! Each sequence is asked for at a server chosen with the probability of the steps that it holds, out of a
//! seeded stream of random numbers. A server that is away is left out, and so is one whose limiter makes draws
//! wait: it keeps one credit, whose sequence says that it is ready again, and gives back the others.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use isodream_core::{Chunk, derive_seed};
use isodream_proto::v1::sample_request::Kind;
use isodream_proto::v1::{ReplayStatus, SampleCredit, SampleHello, SampleReply, SampleRequest};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::sync::mpsc::{self, OwnedPermit};
use tokio::task::{AbortHandle, JoinSet};

use crate::limits::RESOLVE_INTERVAL;
use crate::link_state::LinkState;
use crate::priorities::{BATCHES_AHEAD, PriorityUpdate, message};
use crate::sample_link::{Event, SampleLink};
use crate::sample_watch::SampleWatch;
use crate::{Dialer, SampleOptions, SampledSequence};

/// Credits that a server may keep while its limiter makes draws wait.
const WAITING_CREDITS: u32 = 1;

/// Events between the links and this task at most.
const EVENTS: usize = 64;

pub(crate) struct SampleMerge {
    dialer: Dialer,
    options: SampleOptions,
    watch: SampleWatch,
    sequences: mpsc::Sender<SampledSequence>,
    priorities: mpsc::Receiver<Vec<PriorityUpdate>>,
    /// Room in the channel, one for each sequence that is or will be asked for: credits never exceed it.
    room: VecDeque<OwnedPermit<SampledSequence>>,
    links: BTreeMap<String, Link>,
    servers: BTreeMap<String, Server>,
    rng: ChaCha8Rng,
    connections: u64,
    sampled_steps: BTreeMap<Arc<str>, u64>,
    unlimited_left: u64,
}

/// An address at which a server is looked for.
struct Link {
    state: Arc<LinkState>,
    task: AbortHandle,
}

/// A server that is there.
struct Server {
    store_id: Arc<str>,
    steps: u64,
    is_waiting: bool,
    requests: mpsc::Sender<SampleRequest>,
    /// Credits that are not used up, in the order in which the server serves them: whether each is unlimited.
    granted: VecDeque<bool>,
}

impl SampleMerge {
    pub(crate) fn new(
        dialer: Dialer,
        options: SampleOptions,
        sequences: mpsc::Sender<SampledSequence>,
        priorities: mpsc::Receiver<Vec<PriorityUpdate>>,
        watch: SampleWatch,
    ) -> Self {
        let sampled_steps = options.sampled_steps.iter();
        Self {
            dialer,
            sequences,
            priorities,
            watch,
            room: VecDeque::new(),
            links: BTreeMap::new(),
            servers: BTreeMap::new(),
            rng: ChaCha8Rng::seed_from_u64(derive_seed(options.seed, &["servers"])),
            connections: 0,
            sampled_steps: sampled_steps
                .map(|(store, steps)| (store.as_str().into(), *steps))
                .collect(),
            unlimited_left: options.unlimited_sequences,
            options,
        }
    }

    /// Returns only when a server refuses for good or nobody listens any more.
    pub(crate) async fn run(mut self) {
        let (events, mut reports) = mpsc::channel::<(String, Event)>(EVENTS);
        let mut tasks = JoinSet::new();
        let (found, mut looked_up) = mpsc::channel(1);
        tasks.spawn(look_up(
            self.dialer.clone(),
            self.options.addresses.clone(),
            found,
        ));
        loop {
            self.grant();
            tokio::select! {
                Some((address, event)) = reports.recv() => match event {
                    Event::Refused(error) => {
                        if self.dialer.leads_to(&self.options.addresses, &address).await {
                            self.watch.end(error);
                            return;
                        }
                        // Whoever has taken over the address of a server that moved does not speak for it.
                        tracing::warn!(address, %error, "no replay-server of ours is there any more");
                        self.unlink(&address);
                    }
                    event if self.links.contains_key(&address) => self.happened(address, event),
                    // What a link still said before it ended.
                    _ => {}
                },
                room = self.sequences.clone().reserve_owned() => match room {
                    Ok(room) => self.room.push_back(room),
                    Err(_) => return,
                },
                Some(updates) = self.priorities.recv() => self.send_priorities(&updates),
                Some(addresses) = looked_up.recv() => self.link_to(addresses, &events, &mut tasks),
                Some(_) = tasks.join_next() => {}
            }
        }
    }

    /// Looks for servers at `addresses`, and no more where a name led before and nobody is there.
    fn link_to(
        &mut self,
        addresses: Vec<String>,
        events: &mpsc::Sender<(String, Event)>,
        tasks: &mut JoinSet<()>,
    ) {
        let mut left: Vec<String> = self.links.keys().cloned().collect();
        left.retain(|address| !addresses.contains(address) && !self.servers.contains_key(address));
        for address in left {
            self.unlink(&address);
        }
        for address in addresses {
            if self.links.contains_key(&address) {
                continue;
            }
            let Ok(client) = self.dialer.replay(&address) else {
                continue;
            };
            let state = Arc::new(LinkState::new(&address));
            self.watch.add(state.clone());
            let link = SampleLink {
                address: address.clone(),
                client,
                state: state.clone(),
                requests_ahead: self.credits_ahead() + BATCHES_AHEAD,
                events: events.clone(),
            };
            let task = tasks.spawn(link.run());
            self.links.insert(address, Link { state, task });
        }
    }

    fn unlink(&mut self, address: &str) {
        self.servers.remove(address);
        if let Some(link) = self.links.remove(address) {
            link.task.abort();
            self.watch.remove(&link.state);
        }
    }

    /// Requests queued for a server without priorities: the hello and as many grants as there can be sequences.
    fn credits_ahead(&self) -> usize {
        self.sequences.max_capacity() + 1
    }

    /// Hands updates to the servers that their sequences came from, where these are there and keep up.
    fn send_priorities(&self, updates: &[PriorityUpdate]) {
        for server in self.servers.values() {
            let ours = updates
                .iter()
                .filter(|update| update.store_id == server.store_id);
            let batch = message(ours);
            if batch.priorities.is_empty() {
                continue;
            }
            // Priorities never take the place of a credit.
            if server.requests.capacity() > self.credits_ahead() {
                let _ = server.requests.try_send(request(Kind::Priorities(batch)));
            } else {
                tracing::debug!(store_id = %server.store_id, "dropped priorities: the server is behind");
            }
        }
    }

    fn happened(&mut self, address: String, event: Event) {
        match event {
            Event::Found {
                status,
                requests,
                answer,
            } => {
                let _ = answer.send(self.found(address, status, requests));
            }
            Event::Reply(reply) => {
                if let Err(reason) = self.replied(&address, reply) {
                    tracing::warn!(address, reason, "dropped a replay-server's stream");
                    // Its link notices that the requests ended.
                    self.servers.remove(&address);
                }
            }
            Event::Holds(status) => {
                self.watch.holds(&status);
                if let Some(server) = self.servers.get_mut(&address) {
                    server.steps = status.steps;
                }
            }
            Event::Lost | Event::Refused(_) => {
                self.servers.remove(&address);
            }
        }
    }

    /// Greets a server, unless its store is connected already.
    fn found(
        &mut self,
        address: String,
        status: ReplayStatus,
        requests: mpsc::Sender<SampleRequest>,
    ) -> bool {
        let store_id: Arc<str> = status.store_id.into();
        let mut servers = self.servers.values();
        if servers.any(|server| server.store_id == store_id) {
            return false;
        }
        let sampled_steps = self.sampled_steps.get(&store_id).copied().unwrap_or(0);
        // A new stream of draws per connection, or every reconnection would repeat the first sequences.
        let path = [sampled_steps.to_string(), self.connections.to_string()];
        self.connections += 1;
        let hello = SampleHello {
            handshake: Some(self.options.identity.handshake()),
            sequence_length: self.options.sequence_length,
            sampled_steps,
            seed: derive_seed(self.options.seed, &["sample", &path[0], &path[1]]),
            store_id: store_id.to_string(),
            table: self.options.table.clone(),
            waiting_credits: WAITING_CREDITS,
            learner_epoch: self.options.learner_epoch,
        };
        // Room is certain: the queue is new.
        let _ = requests.try_send(request(Kind::Hello(hello)));
        let server = Server {
            store_id,
            steps: status.steps,
            is_waiting: false,
            requests,
            granted: VecDeque::new(),
        };
        self.servers.insert(address, server);
        true
    }

    /// Grants a credit for every place in the channel that has none yet.
    fn grant(&mut self) {
        while let Ok(room) = self.sequences.clone().try_reserve_owned() {
            self.room.push_back(room);
        }
        let granted = self.servers.values().flat_map(|server| &server.granted);
        let (count, unlimited) = granted.fold((0, 0_u64), |(count, unlimited), is_unlimited| {
            (count + 1, unlimited + u64::from(*is_unlimited))
        });
        let mut unlimited_left = self.unlimited_left.saturating_sub(unlimited);
        let mut credits = BTreeMap::<_, u32>::new();
        for _ in count..self.room.len() {
            let Some(address) = self.choose() else {
                break;
            };
            let is_unlimited = unlimited_left > 0;
            unlimited_left -= u64::from(is_unlimited);
            // Unlimited ones are granted, and so served, first.
            *credits.entry((!is_unlimited, address)).or_default() += 1;
        }
        for ((is_limited, address), sequences) in credits {
            let Some(server) = self.servers.get_mut(&address) else {
                continue;
            };
            let credit = SampleCredit {
                sequences,
                unlimited: !is_limited,
            };
            if server
                .requests
                .try_send(request(Kind::Credit(credit)))
                .is_ok()
            {
                let granted = std::iter::repeat_n(!is_limited, sequences as usize);
                server.granted.extend(granted);
            }
        }
    }

    /// A server that makes nobody wait, by the steps that it holds.
    fn choose(&mut self) -> Option<String> {
        // One that holds nothing yet is asked too, and says what it waits for.
        let ready = || {
            let servers = self.servers.iter().filter(|(_, server)| !server.is_waiting);
            servers.map(|(address, server)| (address, server.steps.max(1)))
        };
        let total: u64 = ready().map(|(_, steps)| steps).sum();
        if total == 0 {
            return None;
        }
        let mut drawn = self.rng.random_range(0..total);
        for (address, steps) in ready() {
            if drawn < steps {
                return Some(address.clone());
            }
            drawn -= steps;
        }
        None
    }

    fn replied(&mut self, address: &str, reply: SampleReply) -> Result<(), String> {
        let Some(server) = self.servers.get_mut(address) else {
            // What was on its way when its stream was dropped.
            return Ok(());
        };
        server.is_waiting = !reply.waiting.is_empty();
        let kept = server
            .granted
            .len()
            .checked_sub(reply.returned_credits as usize);
        server
            .granted
            .truncate(kept.ok_or("it gave back more than it was granted")?);
        if reply.chunks.is_empty() {
            return Ok(());
        }
        let too_many = "it sent more sequences than it was asked for";
        let unlimited = server.granted.pop_front().ok_or(too_many)?;
        let chunks = reply
            .chunks
            .into_iter()
            .map(Chunk::try_from)
            .collect::<Result<Vec<_>, _>>()
            .map_err(|error| error.to_string())?;
        let room = self.room.pop_front().ok_or(too_many)?;
        let store_id = server.store_id.clone();
        let sampled_steps = self.sampled_steps.entry(store_id.clone()).or_default();
        if unlimited {
            self.unlimited_left = self.unlimited_left.saturating_sub(1);
        } else {
            *sampled_steps += u64::from(self.options.sequence_length);
        }
        room.send(SampledSequence {
            episode_id: reply.episode_id,
            start_step: reply.start_step,
            probability: reply.probability,
            chunks,
            offset: reply.offset,
            store_id,
            sampled_steps: *sampled_steps,
        });
        Ok(())
    }
}

/// Tells again and again which servers `addresses` stand for.
async fn look_up(dialer: Dialer, addresses: Vec<String>, found: mpsc::Sender<Vec<String>>) {
    while found.send(dialer.resolve(&addresses).await).await.is_ok() {
        tokio::time::sleep(RESOLVE_INTERVAL).await;
    }
}

fn request(kind: Kind) -> SampleRequest {
    SampleRequest { kind: Some(kind) }
}

#[cfg(test)]
#[path = "sample_merge_tests.rs"]
mod tests;
