//! Servers that do not keep to the protocol.

use isodream_envs::{EnvError, Environment, RemoteFault};
use isodream_proto::v1::environment_reply::Kind as Reply;
use isodream_proto::v1::environment_request::Kind as Request;
use isodream_proto::v1::environment_service_server::{
    EnvironmentService, EnvironmentServiceServer,
};
use isodream_proto::v1::{
    EnvironmentReply, EnvironmentRequest, EnvironmentResults, EnvironmentSpec, EnvironmentWelcome,
};
use isodream_rpc::{RemoteEnvironment, serve, server};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Response, Status, Streaming};

use crate::world::{PATIENT, SHORT, Served, options};

/// A server that answers the greeting, and the first batch, with what the test says; with nothing it hangs.
#[derive(Clone, Default)]
struct OddServer {
    welcome: Option<EnvironmentWelcome>,
    answer: Option<Reply>,
}

fn welcome() -> EnvironmentWelcome {
    EnvironmentWelcome {
        protocol_version: isodream_proto::PROTOCOL_VERSION,
        spec: Some(EnvironmentSpec {
            id: "test/odd".into(),
            height: 2,
            width: 3,
            channels: 3,
            action_dim: 2,
            action_repeat: 1,
            time_limit: 5,
        }),
        environments: 1,
    }
}

#[tonic::async_trait]
impl EnvironmentService for OddServer {
    type RunStream = ReceiverStream<Result<EnvironmentReply, Status>>;

    async fn run(
        &self,
        request: tonic::Request<Streaming<EnvironmentRequest>>,
    ) -> Result<Response<Self::RunStream>, Status> {
        let (replies, answers) = tokio::sync::mpsc::channel(1);
        let mut requests = request.into_inner();
        let Self { welcome, answer } = self.clone();
        tokio::spawn(async move {
            while let Ok(Some(request)) = requests.message().await {
                let kind = match request.kind {
                    Some(Request::Hello(_)) => welcome.clone().map(Reply::Welcome),
                    _ => answer.clone(),
                };
                if let Some(kind) = kind {
                    let _ = replies
                        .send(Ok(EnvironmentReply { kind: Some(kind) }))
                        .await;
                }
            }
        });
        Ok(Response::new(ReceiverStream::new(answers)))
    }
}

#[test]
fn odd_greetings_are_refused_by_name() {
    let with = |change: fn(&mut EnvironmentWelcome)| {
        let mut welcome = welcome();
        change(&mut welcome);
        Some(welcome)
    };
    for (welcome, words) in [
        (
            with(|it| it.protocol_version = 99),
            "protocol version 99 does not match",
        ),
        (with(|it| it.spec = None), "names no spec"),
        (
            with(|it| it.environments = 0),
            "offers 0 environments where 1",
        ),
        (
            with(|it| it.spec.as_mut().unwrap().height = 0),
            "0x3x3 is not possible",
        ),
        (None, "no answer within 400ms"),
    ] {
        let served = serve_odd(OddServer {
            welcome,
            answer: None,
        });
        let error = RemoteEnvironment::connect(
            &isodream_rpc::Dialer::default(),
            &served.address,
            options(SHORT),
        )
        .err()
        .unwrap();
        assert!(error.to_string().contains(words), "{error}");
    }
}

#[test]
fn odd_answers_are_violations_of_the_protocol() {
    let results = |number| {
        Reply::Results(EnvironmentResults {
            number,
            results: Vec::new(),
        })
    };
    for (answer, words) in [
        (results(1), "0 results came for one command"),
        (results(77), "results came for batch 77"),
        (Reply::Welcome(welcome()), "second welcome"),
    ] {
        let served = serve_odd(OddServer {
            welcome: Some(welcome()),
            answer: Some(answer),
        });
        let mut env = served.connect(PATIENT);
        let error = env.reset(1).unwrap_err();
        let EnvError::Remote {
            fault: RemoteFault::Protocol(reason),
            ..
        } = &error
        else {
            panic!("{error}");
        };
        assert!(reason.contains(words), "{reason}");
    }
}

fn serve_odd(service: OddServer) -> Served {
    let router = server(&isodream_rpc::Door::default())
        .unwrap()
        .add_service(EnvironmentServiceServer::new(service));
    Served::start("127.0.0.1:0", |listener, shutdown| {
        serve(router, listener, shutdown)
    })
}
