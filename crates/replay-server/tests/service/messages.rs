//! Messages that no client of ours sends: each is answered with a reason, and the server goes on.

use std::time::Duration;

use isodream_proto::v1::append_request::Kind;
use isodream_proto::v1::{
    AppendReply, AppendRequest, Chunk, Handshake, Hello, SampleCredit, SampleHello, SampleReply,
    SampleRequest, sample_request,
};
use isodream_rpc::limits::{MAX_MESSAGE_BYTES, STREAM_WINDOW_BYTES};
use tokio::runtime::Runtime;
use tokio_stream::wrappers::ReceiverStream;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::{Code, Request, Status};
use tonic_prost::ProstCodec;

use crate::common::{DEADLINE, NO_LIMIT, STEPS, Server, actor, chunk, identity};

fn handshake() -> Handshake {
    identity("highway/day").handshake()
}

fn hello(handshake: Handshake, actor_id: &str) -> Kind {
    Kind::Hello(Hello {
        handshake: Some(handshake),
        actor_id: actor_id.to_owned(),
        epoch: 1,
        ..Hello::default()
    })
}

fn numbered() -> Chunk {
    let mut chunk = Chunk::from(chunk(0));
    (chunk.actor_id, chunk.epoch) = ("actor-7".to_owned(), 1);
    chunk
}

/// How an append stream with these requests ends.
async fn append(server: &Server, kinds: Vec<Option<Kind>>) -> Status {
    let requests = kinds.into_iter().map(|kind| AppendRequest { kind });
    let mut client = isodream_rpc::Dialer::default()
        .replay(&server.address)
        .unwrap()
        .max_encoding_message_size(usize::MAX);
    let replies = client.append(tokio_stream::iter(requests)).await;
    match replies {
        Ok(replies) => end(replies.into_inner()).await,
        Err(status) => status,
    }
}

/// How a sample stream with these requests ends.
async fn sample(server: &Server, kinds: Vec<sample_request::Kind>) -> Status {
    let (requests, outbound) = tokio::sync::mpsc::channel(kinds.len());
    for kind in kinds {
        let request = SampleRequest { kind: Some(kind) };
        requests.try_send(request).unwrap();
    }
    let mut client = isodream_rpc::Dialer::default()
        .replay(&server.address)
        .unwrap();
    match client.sample(ReceiverStream::new(outbound)).await {
        Ok(replies) => end(replies.into_inner()).await,
        Err(status) => status,
    }
}

async fn end<T>(mut replies: tonic::Streaming<T>) -> Status {
    let ended = async {
        loop {
            match replies.message().await {
                Ok(Some(_)) => {}
                Ok(None) => panic!("the stream ended without a reason"),
                Err(status) => return status,
            }
        }
    };
    tokio::time::timeout(DEADLINE, ended).await.unwrap()
}

fn sample_hello(handshake: Handshake) -> sample_request::Kind {
    sample_request::Kind::Hello(SampleHello {
        handshake: Some(handshake),
        sequence_length: 5,
        table: "train".into(),
        ..SampleHello::default()
    })
}

fn credit(sequences: u32) -> sample_request::Kind {
    sample_request::Kind::Credit(SampleCredit {
        sequences,
        unlimited: false,
    })
}

/// Runs `bad` and then sees whether a real actor is served.
fn outlived(bad: impl AsyncFnOnce(&Server)) {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    Runtime::new().unwrap().block_on(async {
        bad(&server).await;
        let actor = actor(&server.address, 8);
        actor.send(chunk(0)).await.unwrap();
        actor.flush(DEADLINE).await.unwrap();
        let inserted = crate::experience::inserted_steps(&server.address).await;
        assert_eq!(inserted, u64::from(STEPS), "nothing else was stored");
    });
    server.stop().unwrap();
}

#[track_caller]
fn refused(status: &Status, words: &str) {
    assert!(isodream_rpc::is_refusal(status), "{status}");
    assert!(status.message().contains(words), "{status}");
}

#[test]
fn another_protocol_is_refused_on_both_streams() {
    outlived(async |server| {
        let mut old = handshake();
        old.protocol_version -= 1;
        let status = append(server, vec![Some(hello(old.clone(), "actor-7"))]).await;
        refused(&status, "protocol version");
        refused(
            &sample(server, vec![sample_hello(old)]).await,
            "protocol version",
        );
    });
}

#[test]
fn hellos_come_once_and_requests_are_not_empty() {
    outlived(async |server| {
        let hello = || Some(hello(handshake(), "actor-7"));
        let one_hello = "takes one hello and then";
        refused(&append(server, vec![hello(), hello()]).await, one_hello);
        refused(&append(server, vec![hello(), None]).await, one_hello);
        let hellos = vec![sample_hello(handshake()), sample_hello(handshake())];
        refused(&sample(server, hellos).await, one_hello);
        refused(&append(server, vec![None]).await, "no handshake");
    });
}

#[test]
fn chunks_and_names_that_cannot_be_stored_are_refused() {
    outlived(async |server| {
        let status = append(server, vec![Some(hello(handshake(), ""))]).await;
        refused(&status, "actor id");
        let long = "a".repeat(10_000);
        refused(
            &append(server, vec![Some(hello(handshake(), &long))]).await,
            "actor id",
        );
        for (change, words) in [
            (
                (|chunk: &mut Chunk| chunk.steps = 0) as fn(&mut Chunk),
                "no steps",
            ),
            (
                |chunk| chunk.actor_id = "another".into(),
                "came on the stream of",
            ),
            (|chunk| chunk.epoch = 9, "came on the stream of"),
            (
                |chunk| chunk.payload = vec![0; (32 << 20) + 1].into(),
                "chunk 0",
            ),
        ] {
            let mut bad = numbered();
            change(&mut bad);
            let kinds = vec![Some(hello(handshake(), "actor-7")), Some(Kind::Chunk(bad))];
            refused(&append(server, kinds).await, words);
        }
    });
}

#[test]
fn messages_beyond_the_cap_are_refused_by_their_announced_size() {
    outlived(async |server| {
        let mut large = numbered();
        large.payload = vec![0; MAX_MESSAGE_BYTES + 1].into();
        // Not even its first window is needed to know.
        assert!(large.payload.len() > STREAM_WINDOW_BYTES as usize);
        let kinds = vec![
            Some(hello(handshake(), "actor-7")),
            Some(Kind::Chunk(large)),
        ];
        refused(&append(server, kinds).await, "message length too large");
    });
}

#[test]
fn bytes_that_are_no_message_are_refused() {
    outlived(async |server| {
        // A reply sent as a request: its chunk's name stands where a handshake has to be.
        let reply = SampleReply {
            chunks: vec![numbered()],
            ..SampleReply::default()
        };
        let mut grpc = tonic::client::Grpc::new(
            isodream_rpc::Dialer::default()
                .wire(&server.address)
                .unwrap(),
        );
        grpc.ready().await.unwrap();
        let path = PathAndQuery::from_static("/isodream.v1.ReplayService/Append");
        let codec = ProstCodec::<SampleReply, AppendReply>::default();
        let status = grpc
            .streaming(Request::new(tokio_stream::iter([reply])), path, codec)
            .await
            .map(|_| ())
            .unwrap_err();
        assert!(status.message().contains("decode"), "{status}");
    });
}

#[test]
fn compressed_messages_are_refused_unread() {
    outlived(async |server| {
        let kind = Some(hello(handshake(), "actor-7"));
        let mut request = Request::new(tokio_stream::iter([AppendRequest { kind }]));
        let encoding = "gzip".parse().unwrap();
        request.metadata_mut().insert("grpc-encoding", encoding);
        let mut client = isodream_rpc::Dialer::default()
            .replay(&server.address)
            .unwrap();
        let status = client.append(request).await.map(|_| ()).unwrap_err();
        assert_eq!(status.code(), Code::Unimplemented);
        refused(&status, "gzip");
    });
}

#[test]
fn credits_are_capped() {
    outlived(async |server| {
        for credits in [
            vec![credit(0)],
            vec![credit(u32::MAX)],
            vec![credit(60_000); 2],
        ] {
            let mut kinds = vec![sample_hello(handshake())];
            kinds.extend(credits);
            refused(&sample(server, kinds).await, "grant 1 to 65536");
        }
    });
}

#[test]
fn streams_that_say_nothing_keep_nobody_out() {
    outlived(async |server| {
        let client = isodream_rpc::Dialer::default()
            .replay(&server.address)
            .unwrap();
        let mut silent = Vec::new();
        for _ in 0..150 {
            let (requests, outbound) = tokio::sync::mpsc::channel(1);
            let mut client = client.clone();
            let stream = tokio::spawn(async move {
                let answer = client.append(ReceiverStream::new(outbound)).await;
                answer.map(|_| ())
            });
            silent.push((requests, stream));
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
        assert!(silent.iter().all(|(_, stream)| !stream.is_finished()));
        // They stay open while the real actor comes.
        tokio::spawn(async move {
            for (_requests, stream) in silent {
                let _ = stream.await;
            }
        });
    });
}
