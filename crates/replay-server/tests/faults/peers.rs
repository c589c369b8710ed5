//! Peers that hang: open streams, and nobody at the other end.

use std::time::{Duration, Instant};

use isodream_proto::v1::{
    AppendRequest, Hello, SampleCredit, SampleHello, SampleReply, SampleRequest, append_request,
    sample_request,
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

use crate::process::{
    DEADLINE, ServerProcess, actor, chunk, free_address, identity, inserted_steps,
};

/// Sequences that a stopped learner asked for, as many as a server grants: far more than transport and server hold.
const CREDITS: u32 = 1 << 16;
/// What the server may grow by while a learner does not read: the windows of its connection and some more.
const MEMORY_BYTES: u64 = 96 << 20;

#[test]
fn half_dead_peers_keep_nobody_out_and_a_stopped_learner_costs_bounded_memory() {
    let folder = tempfile::tempdir().unwrap();
    let address = free_address();
    let server = ServerProcess::start(folder.path(), &address, u64::MAX, "");
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        inserted_steps(&address).await;
        // Something to sample.
        let first = actor(&address, 100);
        for seq in 0..50 {
            first.send(chunk(100, seq)).await.unwrap();
        }
        first.flush(DEADLINE).await.unwrap();

        let mut peers = Vec::new();
        for number in 0..8 {
            peers.push(hanging_actor(&address, number).await);
        }
        let before = server.resident_bytes();
        let mut learners = Vec::new();
        for _ in 0..8 {
            learners.push(hanging_learner(&address).await);
        }
        // A newer process of each hanging actor gets through meanwhile, also while nobody reads the samples.
        let since = Instant::now();
        let mut seq = 0;
        let replacements: Vec<_> = (0..8).map(|number| actor(&address, number)).collect();
        while since.elapsed() < Duration::from_secs(4) {
            for (number, replacement) in (0..).zip(&replacements) {
                replacement.send(chunk(number, seq)).await.unwrap();
            }
            seq += 1;
        }
        for replacement in &replacements {
            replacement.flush(DEADLINE).await.unwrap();
        }
        let grown = server.resident_bytes().saturating_sub(before);
        eprintln!(
            "{} chunks inserted beside hanging peers, server grew by {} KB",
            8 * seq,
            grown >> 10
        );
        assert!(grown < MEMORY_BYTES, "the server grew by {grown} bytes");
        for learner in &mut learners {
            let next = learner.next().await;
            assert!(next.is_ok(), "the server still sends: {next:?}");
        }
        drop((peers, learners));
    });
}

/// An actor that says hello and nothing more; what keeps its streams open.
async fn hanging_actor(address: &str, number: u64) -> impl Sized {
    let (requests, outbound) = mpsc::channel(1);
    let hello = Hello {
        handshake: Some(identity().handshake()),
        actor_id: format!("actor-{number}"),
        ..Hello::default()
    };
    let kind = Some(append_request::Kind::Hello(hello));
    requests.send(AppendRequest { kind }).await.unwrap();
    let mut client = isodream_rpc::Dialer::default().replay(address).unwrap();
    let append = client.append(ReceiverStream::new(outbound));
    (requests, append.await.unwrap(), client)
}

/// A learner that reads one of very many sequences, and then no more until it is asked.
struct HangingLearner {
    replies: Streaming<SampleReply>,
    /// Keeps the stream open.
    _requests: mpsc::Sender<SampleRequest>,
}

impl HangingLearner {
    async fn next(&mut self) -> Result<SampleReply, Status> {
        self.replies
            .message()
            .await?
            .ok_or_else(|| Status::cancelled("the stream ended"))
    }
}

async fn hanging_learner(address: &str) -> HangingLearner {
    let (requests, outbound) = mpsc::channel(2);
    let hello = SampleHello {
        handshake: Some(identity().handshake()),
        sequence_length: 50,
        table: "train".into(),
        seed: 1,
        ..SampleHello::default()
    };
    let credit = SampleCredit {
        sequences: CREDITS,
        unlimited: true,
    };
    for kind in [
        sample_request::Kind::Hello(hello),
        sample_request::Kind::Credit(credit),
    ] {
        let kind = Some(kind);
        requests.send(SampleRequest { kind }).await.unwrap();
    }
    let mut client = isodream_rpc::Dialer::default().replay(address).unwrap();
    let sample = client.sample(ReceiverStream::new(outbound));
    let mut learner = HangingLearner {
        replies: sample.await.unwrap().into_inner(),
        _requests: requests,
    };
    learner.next().await.unwrap();
    learner
}
