//! Servers behind doors, over real sockets: who comes in, and what those hear who do not.

#![allow(clippy::unwrap_used)]

mod authority;

use std::time::Duration;

use isodream_proto::v1::replay_service_server::ReplayServiceServer;
use isodream_proto::v1::{AppendRequest, ReplayStatusRequest, SampleRequest, WatchPolicyRequest};
use isodream_rpc::{Credentials, Dialer, Door, Files, bind, serve, server};
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::{Code, Status};

use authority::{ACTOR, Authority, LEARNER, VIEWER};

const SOON: Duration = Duration::from_secs(5);

/// A server with a health service alone: what passes its guard is told that there is no such service.
struct Served {
    port: u16,
    _stop: DropGuard,
}

impl Served {
    async fn behind(door: Door) -> Self {
        let listener = bind("127.0.0.1:0", &door).await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let shutdown = CancellationToken::new();
        let (_, health) = tonic_health::server::health_reporter();
        let router = server(&door).unwrap().add_service(health);
        tokio::spawn(serve(router, listener, shutdown.clone()));
        Self {
            port,
            _stop: shutdown.drop_guard(),
        }
    }

    /// By the name that certificates are made out to.
    fn address(&self) -> String {
        format!("localhost:{}", self.port)
    }

    async fn health(&self, files: &Files) -> Result<(), String> {
        let dialer = Dialer::new(Credentials::load(files).unwrap());
        let checked = dialer.check_health(&self.address(), SOON).await;
        checked.map_err(|error| error.to_string())
    }

    /// What a call of `ReplayService.Status` is answered.
    async fn status(&self, files: &Files) -> Status {
        let dialer = Dialer::new(Credentials::load(files).unwrap());
        let mut client = dialer.replay(&self.address()).unwrap();
        client.status(ReplayStatusRequest {}).await.unwrap_err()
    }
}

#[tokio::test]
async fn a_token_opens_what_its_role_may_call() {
    let authority = Authority::new("a");
    let served = Served::behind(Door::load(&authority.tokens()).unwrap()).await;
    for (token, appends, samples, watches) in [
        (ACTOR, true, false, true),
        (LEARNER, false, true, false),
        (VIEWER, false, false, false),
    ] {
        let dialer = Dialer::new(Credentials::load(&authority.token(token)).unwrap());
        let mut replay = dialer.replay(&served.address()).unwrap();
        let mut learner = dialer.learner(&served.address()).unwrap();
        let requests = || tokio_stream::empty::<AppendRequest>();
        let append = replay.append(requests()).await.unwrap_err();
        let sample = replay.sample(tokio_stream::empty::<SampleRequest>()).await;
        let watch = learner.watch_policy(WatchPolicyRequest::default()).await;
        for (status, allowed) in [
            (append, appends),
            (sample.unwrap_err(), samples),
            (watch.unwrap_err(), watches),
            (
                replay.status(ReplayStatusRequest {}).await.unwrap_err(),
                true,
            ),
        ] {
            let expected = match allowed {
                true => Code::Unimplemented,
                false => Code::PermissionDenied,
            };
            assert_eq!(status.code(), expected, "{token}: {status}");
            assert!(!status.message().contains(token));
        }
    }
}

#[tokio::test]
async fn without_a_known_token_there_is_health_alone() {
    let authority = Authority::new("a");
    let served = Served::behind(Door::load(&authority.tokens()).unwrap()).await;
    let none = served.status(&Files::default()).await;
    assert_eq!(none.code(), Code::Unauthenticated);
    assert!(none.message().contains("--token-file"), "{none}");
    let wrong = served
        .status(&authority.token("actor-token-012345678X"))
        .await;
    assert_eq!(wrong.code(), Code::Unauthenticated);
    assert!(
        wrong.message().contains("does not know the token"),
        "{wrong}"
    );
    assert!(!wrong.message().contains("012345678X"));
    served.health(&Files::default()).await.unwrap();
}

#[tokio::test]
async fn certificates_are_checked_on_both_sides_and_the_reason_is_told() {
    let (ours, theirs) = (Authority::new("ours"), Authority::new("theirs"));
    let trusting = |authority: &Authority| Files {
        ca: Some(authority.ca()),
        ..Files::default()
    };
    let door = Door::load(&ours.server()).unwrap();
    let served = Served::behind(door).await;
    served.health(&trusting(&ours)).await.unwrap();
    let other = served.health(&trusting(&theirs)).await.unwrap_err();
    assert!(other.contains("another authority than --tls-ca"), "{other}");
    // The handshake's failure may reach the client as an alert, which it can tell, or as a closed connection.
    let told = async {
        while !served
            .health(&Files::default())
            .await
            .unwrap_err()
            .contains("it seems to speak TLS: give --tls-ca")
        {}
    };
    tokio::time::timeout(SOON, told).await.unwrap();

    let expired = Served::behind(Door::load(&ours.server_until(2020)).unwrap()).await;
    let expired = expired.health(&trusting(&ours)).await.unwrap_err();
    assert!(expired.contains("make new certificates"), "{expired}");

    let open = Served::behind(Door::default()).await;
    open.health(&Files::default()).await.unwrap();
    let encrypted = open.health(&trusting(&ours)).await.unwrap_err();
    assert!(encrypted.contains("does not speak TLS"), "{encrypted}");
}

#[tokio::test]
async fn mutual_tls_lets_in_who_shows_a_good_certificate() {
    let (ours, theirs) = (Authority::new("ours"), Authority::new("theirs"));
    let demanding = Files {
        client_ca: Some(ours.ca()),
        ..ours.server()
    };
    let door = Door::load(&demanding).unwrap();
    door.check("10.0.0.1:7001".parse().unwrap()).unwrap();
    let served = Served::behind(door).await;
    served.health(&ours.client_until(2998)).await.unwrap();
    let nothing = Files {
        ca: Some(ours.ca()),
        ..Files::default()
    };
    let foreign = Files {
        ca: Some(ours.ca()),
        ..theirs.client_until(2998)
    };
    for (files, words) in [
        (nothing, "CertificateRequired"),
        (foreign, "UnknownCA"),
        (ours.client_until(2020), "CertificateExpired"),
    ] {
        let error = served.health(&files).await.unwrap_err();
        assert!(error.contains(words), "{words} is not in {error}");
    }
}

#[tokio::test]
async fn connections_of_a_token_are_limited_and_given_back() {
    let authority = Authority::new("a");
    let door = Door::load(&authority.tokens()).unwrap();
    let served = Served::behind(door.with_max_connections(2)).await;
    let connected = async |token: &str| {
        let dialer = Dialer::new(Credentials::load(&authority.token(token)).unwrap());
        let mut client = dialer.replay(&served.address()).unwrap();
        let status = client.status(ReplayStatusRequest {}).await.unwrap_err();
        (client, status)
    };
    let (first, _) = connected(VIEWER).await;
    let (_second, _) = connected(VIEWER).await;
    let (_third, refused) = connected(VIEWER).await;
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused}");
    assert!(
        refused.message().contains("the viewer token of line 3"),
        "{refused}"
    );
    let (_other, other) = connected(ACTOR).await;
    assert_eq!(other.code(), Code::Unimplemented, "others have their own");

    drop(first);
    let freed = async {
        loop {
            let (client, status) = connected(VIEWER).await;
            if status.code() == Code::Unimplemented {
                return client;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(SOON, freed).await.unwrap();
}

#[tokio::test]
async fn an_unguarded_server_does_not_listen_for_other_machines() {
    let error = bind("0.0.0.0:0", &Door::default())
        .await
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("--insecure") && error.contains("--secrets"),
        "{error}"
    );
    bind("0.0.0.0:0", &Door::default().insecure())
        .await
        .unwrap();
}

#[test]
fn the_services_here_are_the_ones_that_roles_are_about() {
    use tonic::server::NamedService;
    // The guard goes by names; a renamed service would lock everybody out.
    assert_eq!(ReplayServiceServer::<()>::NAME, "isodream.v1.ReplayService");
}
