//! Shutting down: what arrived is stored and acknowledged, then everyone hears why the stream ends.

use crate::common::{DEADLINE, NO_LIMIT, Server, chunk, identity};
use isodream_proto::v1::{AppendRequest, Hello, append_request::Kind};
use isodream_replay::{Store, StoreOptions};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

#[test]
fn everything_stored_is_acknowledged_before_the_stream_ends() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), NO_LIMIT);
    let address = server.address.clone();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let acknowledged = runtime.block_on(async {
        let mut health = HealthClient::new(isodream_rpc::Dialer::default().wire(&address).unwrap());
        let service = "isodream.v1.ReplayService".to_owned();
        let mut watch = health
            .watch(HealthCheckRequest { service })
            .await
            .unwrap()
            .into_inner();
        let serving = watch.message().await.unwrap().unwrap();
        assert_eq!(serving.status(), ServingStatus::Serving);

        let (requests, outbound) = mpsc::channel(4);
        let hello = Hello {
            handshake: Some(identity("highway/day").handshake()),
            actor_id: "actor-0".into(),
            epoch: 1,
            ..Hello::default()
        };
        let kind = Some(Kind::Hello(hello));
        requests.send(AppendRequest { kind }).await.unwrap();
        let mut client = isodream_rpc::Dialer::default().replay(&address).unwrap();
        let append = client.append(ReceiverStream::new(outbound));
        let mut replies = append.await.unwrap().into_inner();
        // Chunks for as long as the server takes them.
        let sender = tokio::spawn(async move {
            for seq in 0.. {
                let mut chunk = chunk(seq);
                chunk.actor_id = "actor-0".into();
                chunk.epoch = 1;
                chunk.seq = seq;
                let kind = Some(Kind::Chunk(chunk.into()));
                if requests.send(AppendRequest { kind }).await.is_err() {
                    return;
                }
            }
        });
        let mut durable_seq = 0;
        while durable_seq < 50 {
            durable_seq = replies.message().await.unwrap().unwrap().durable_seq;
        }
        let stopped = tokio::task::spawn_blocking(move || server.stop());
        let status = loop {
            match replies.message().await {
                Ok(Some(reply)) => durable_seq = reply.durable_seq,
                Ok(None) => panic!("the stream ended without a reason"),
                Err(status) => break status,
            }
        };
        assert_eq!(status.code(), Code::Unavailable, "{status:?}");
        assert!(status.message().contains("shutting down"), "{status}");
        let draining = watch.message().await.unwrap().unwrap();
        assert_eq!(draining.status(), ServingStatus::NotServing);
        drop((watch, health));
        stopped.await.unwrap().unwrap();
        tokio::time::timeout(DEADLINE, sender)
            .await
            .unwrap()
            .unwrap();
        durable_seq
    });
    let (_, _, recovery) = Store::open(folder.path(), &StoreOptions::default()).unwrap();
    assert_eq!(recovery.chunks, acknowledged);
}
