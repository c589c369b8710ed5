//! The task behind a [`crate::SampleClient`].

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use isodream_core::{Chunk, derive_seed};
use isodream_proto::v1::replay_service_client::ReplayServiceClient;
use isodream_proto::v1::sample_request::Kind;
use isodream_proto::v1::{SampleCredit, SampleHello, SampleReply, SampleRequest};
use tokio::sync::mpsc::{self, OwnedPermit};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use tonic::transport::Channel;

use crate::error::words;
use crate::limits::RECONNECT_DELAYS;
use crate::link_state::LinkState;
use crate::{SampleOptions, SampledSequence, is_refusal, reconnect_delays};

pub(crate) struct SampleLink {
    client: ReplayServiceClient<Channel>,
    options: SampleOptions,
    sequences: mpsc::Sender<SampledSequence>,
    state: Arc<LinkState>,
    /// Room in the channel, one for each sequence that is or will be asked for: credits never exceed it.
    room: VecDeque<OwnedPermit<SampledSequence>>,
    connections: u64,
    sampled_steps: u64,
    unlimited_left: u64,
}

/// Credits granted on one connection and not used up, in the order in which the server serves them.
#[derive(Default)]
struct Granted {
    unlimited: VecDeque<bool>,
}

impl SampleLink {
    pub(crate) fn new(
        client: ReplayServiceClient<Channel>,
        options: SampleOptions,
        sequences: mpsc::Sender<SampledSequence>,
        state: Arc<LinkState>,
    ) -> Self {
        Self {
            client,
            sampled_steps: options.sampled_steps,
            unlimited_left: options.unlimited_sequences,
            options,
            sequences,
            state,
            room: VecDeque::new(),
            connections: 0,
        }
    }

    /// Connects again and again; returns only when the server refuses for good or nobody listens any more.
    pub(crate) async fn run(&mut self) {
        let mut delays = reconnect_delays();
        loop {
            let mut progressed = false;
            let since = Instant::now();
            let status = match self.connection(&mut progressed).await {
                Ok(()) => Status::unavailable("the server closed the stream"),
                Err(status) => status,
            };
            if is_refusal(&status) {
                self.state.end(self.state.refused(words(&status)));
                return;
            }
            if self.sequences.is_closed() {
                return;
            }
            self.state.lost(words(&status));
            if progressed || since.elapsed() > RECONNECT_DELAYS.1 {
                delays = reconnect_delays();
            }
            tokio::time::sleep(delays.next().unwrap_or_default()).await;
        }
    }

    async fn connection(&mut self, progressed: &mut bool) -> Result<(), Status> {
        // Room for the hello and for as many grants as there can be sequences.
        let (outbound, requests) = mpsc::channel(self.options.prefetch.max(1) + 1);
        let _ = outbound.try_send(request(Kind::Hello(self.hello())));
        self.connections += 1;
        let mut granted = Granted::default();
        let mut client = self.client.clone();
        let mut replies = client
            .sample(ReceiverStream::new(requests))
            .await?
            .into_inner();
        self.state.connected();
        loop {
            self.grant(&mut granted, &outbound);
            tokio::select! {
                reply = replies.message() => match reply? {
                    Some(reply) if reply.chunks.is_empty() => self.state.peer_waits(&reply.waiting),
                    Some(reply) => {
                        *progressed = true;
                        self.state.peer_waits("");
                        self.receive(reply, &mut granted)?;
                    }
                    None => return Ok(()),
                },
                room = self.sequences.clone().reserve_owned() => match room {
                    Ok(room) => self.room.push_back(room),
                    Err(_) => return Ok(()),
                },
            }
        }
    }

    fn hello(&self) -> SampleHello {
        // A new stream of draws per connection, or every reconnection would repeat the first sequences.
        let path = [self.sampled_steps.to_string(), self.connections.to_string()];
        SampleHello {
            handshake: Some(self.options.identity.handshake()),
            sequence_length: self.options.sequence_length,
            sampled_steps: self.sampled_steps,
            seed: derive_seed(self.options.seed, &["sample", &path[0], &path[1]]),
        }
    }

    /// Grants a credit for every place in the channel that has none yet.
    fn grant(&mut self, granted: &mut Granted, outbound: &mpsc::Sender<SampleRequest>) {
        while let Ok(room) = self.sequences.clone().try_reserve_owned() {
            self.room.push_back(room);
        }
        let unlimited_granted = granted
            .unlimited
            .iter()
            .filter(|unlimited| **unlimited)
            .count();
        let missing = self.room.len() - granted.unlimited.len();
        let unlimited_missing = self.unlimited_left.saturating_sub(unlimited_granted as u64);
        let unlimited = missing.min(usize::try_from(unlimited_missing).unwrap_or(usize::MAX));
        for (count, unlimited) in [(unlimited, true), (missing - unlimited, false)] {
            let credit = SampleCredit {
                sequences: count as u32,
                unlimited,
            };
            if count > 0 && outbound.try_send(request(Kind::Credit(credit))).is_ok() {
                granted
                    .unlimited
                    .extend(std::iter::repeat_n(unlimited, count));
            }
        }
    }

    fn receive(&mut self, reply: SampleReply, granted: &mut Granted) -> Result<(), Status> {
        let (Some(unlimited), Some(room)) = (granted.unlimited.pop_front(), self.room.pop_front())
        else {
            return Err(Status::internal(
                "the server sent more sequences than it was asked for",
            ));
        };
        let chunks = reply
            .chunks
            .into_iter()
            .map(Chunk::try_from)
            .collect::<Result<Vec<_>, _>>()
            .map_err(|error| Status::internal(error.to_string()))?;
        if unlimited {
            self.unlimited_left = self.unlimited_left.saturating_sub(1);
        } else {
            self.sampled_steps += u64::from(self.options.sequence_length);
        }
        room.send(SampledSequence {
            chunks,
            offset: reply.offset,
            sampled_steps: self.sampled_steps,
        });
        Ok(())
    }
}

fn request(kind: Kind) -> SampleRequest {
    SampleRequest { kind: Some(kind) }
}
