//! Environments over real sockets: what arrives is what was sent, and what goes wrong is said.

#![allow(clippy::unwrap_used)]

use std::num::NonZeroUsize;
use std::time::{Duration, Instant};

use isodream_core::config::EnvConfig;
use isodream_core::{EnvSpec, ImageShape};
use isodream_envs::{
    EndReason, EnvError, Environment, PrivilegedView, RemoteFault, Transition, VectorEnvironment,
};
use isodream_proto::v1::environment_reply::Kind as Reply;
use isodream_proto::v1::environment_request::Kind as Request;
use isodream_proto::v1::environment_service_server::{
    EnvironmentService, EnvironmentServiceServer,
};
use isodream_proto::v1::{
    EnvironmentReply, EnvironmentRequest, EnvironmentResults, EnvironmentSpec, EnvironmentWelcome,
};
use isodream_rpc::{EnvironmentServer, RemoteEnvironment, RemoteOptions, bind, serve, server};
use tokio::runtime::Runtime;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Response, Status, Streaming};

const TWO: NonZeroUsize = NonZeroUsize::new(2).unwrap();

/// A server in this process that ends with the value.
struct Served {
    address: String,
    shutdown: CancellationToken,
    runtime: Option<Runtime>,
}

impl Served {
    fn environments(environments: Vec<Box<dyn Environment>>) -> Self {
        Self::environments_at("127.0.0.1:0", environments)
    }

    fn environments_at(address: &str, environments: Vec<Box<dyn Environment>>) -> Self {
        let service = EnvironmentServer::new(environments, TWO).unwrap();
        Self::start(address, |listener, shutdown| {
            service.serve(listener, shutdown)
        })
    }

    fn odd(service: OddServer) -> Self {
        let router = server().add_service(EnvironmentServiceServer::new(service));
        Self::start("127.0.0.1:0", |listener, shutdown| {
            serve(router, listener, shutdown)
        })
    }

    fn start<F>(
        address: &str,
        serving: impl FnOnce(tokio::net::TcpListener, CancellationToken) -> F,
    ) -> Self
    where
        F: Future<Output = Result<(), isodream_rpc::RpcError>> + Send + 'static,
    {
        let runtime = Runtime::new().unwrap();
        let bound = |address| {
            std::thread::scope(|scope| {
                // Also called on threads of other runtimes, which may not block on this one.
                scope
                    .spawn(|| runtime.block_on(bind(address)))
                    .join()
                    .unwrap()
            })
        };
        let listener = bound(address).unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let shutdown = CancellationToken::new();
        runtime.spawn(serving(listener, shutdown.clone()));
        Self {
            address,
            shutdown,
            runtime: Some(runtime),
        }
    }

    /// As a process that is killed: connections break.
    fn kill(mut self) -> String {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
        self.address.clone()
    }

    fn connect(&self, deadline: Duration) -> RemoteEnvironment {
        RemoteEnvironment::connect(&self.address, options(deadline)).unwrap()
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        self.shutdown.cancel();
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

fn options(deadline: Duration) -> RemoteOptions {
    RemoteOptions {
        deadline,
        ..RemoteOptions::default()
    }
}

const PATIENT: Duration = Duration::from_secs(20);
const SHORT: Duration = Duration::from_millis(400);

/// What a [`World`] does at its third step.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Act {
    Nothing,
    Hang(Duration),
    NanReward,
    ShortImage,
    Fail,
    Panic,
}

/// A world of 2 x 3 pixels.
struct World {
    spec: EnvSpec,
    act: Act,
    step: u8,
}

impl World {
    fn boxed(act: Act) -> Box<dyn Environment> {
        Box::new(Self {
            spec: EnvSpec {
                id: "test/world".into(),
                image: ImageShape {
                    height: 2,
                    width: 3,
                    channels: 3,
                },
                action_dim: 2,
                action_repeat: 1,
                time_limit: 5,
            },
            act,
            step: 0,
        })
    }

    fn row(&self, reward: f32) -> Transition {
        Transition {
            image: vec![self.step; 18],
            reward,
            discount: 1.0,
            is_last: self.step == 5,
            is_terminal: false,
            interaction: self.step == 2,
            end_reason: (self.step == 5).then_some(EndReason::TimeLimit),
        }
    }
}

impl Environment for World {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, _seed: u64) -> Result<Transition, EnvError> {
        self.step = 0;
        Ok(self.row(0.0))
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        self.step += 1;
        let mut row = self.row(action.iter().sum());
        if self.step == 3 {
            match self.act {
                Act::Nothing => {}
                Act::Hang(time) => std::thread::sleep(time),
                Act::NanReward => row.reward = f32::NAN,
                Act::ShortImage => row.image.truncate(7),
                Act::Fail => return Err(EnvError::EpisodeOver),
                Act::Panic => panic!("as the test asks"),
            }
        }
        Ok(row)
    }

    fn segmentation(&self) -> Option<Vec<u8>> {
        Some(vec![1; 6])
    }

    fn metrics(&self) -> Vec<(&'static str, f64)> {
        vec![("steps", f64::from(self.step))]
    }

    fn privileged(&self) -> Option<PrivilegedView> {
        None
    }
}

/// Resets and makes two of the three steps that [`Act`] waits for.
fn two_steps(env: &mut dyn Environment) {
    env.reset(1).unwrap();
    for _ in 0..2 {
        env.step(&[0.0; 2]).unwrap();
    }
}

#[test]
fn a_remote_environment_is_its_original() {
    let config = EnvConfig {
        time_limit: 4,
        vehicles: 5,
        ..EnvConfig::default()
    };
    let mut local = isodream_envs::make(&config).unwrap();
    let served = Served::environments(vec![isodream_envs::make(&config).unwrap()]);
    let with_classes = RemoteOptions {
        segmentation: true,
        ..options(PATIENT)
    };
    let mut remote = RemoteEnvironment::connect(&served.address, with_classes).unwrap();
    assert_eq!(remote.spec(), local.spec());
    assert_eq!(remote.step(&[0.0, 1.0]), Err(EnvError::NotReset));
    for seed in [3, 4] {
        assert_eq!(remote.reset(seed), local.reset(seed));
        for step in 0..4 {
            let action = [0.1 * step as f32, 1.7];
            assert_eq!(remote.step(&action), local.step(&action));
            assert_eq!(remote.segmentation(), local.segmentation());
            assert_eq!(remote.metrics(), local.metrics());
        }
        assert_eq!(remote.step(&[0.0, 0.0]), Err(EnvError::EpisodeOver));
    }
    let wrong = remote.step(&[0.0; 3]);
    assert_eq!(
        wrong,
        Err(EnvError::ActionDim {
            expected: 2,
            actual: 3
        })
    );
}

#[test]
fn a_batch_of_remote_environments_runs_over_one_connection() {
    let config = EnvConfig {
        time_limit: 3,
        vehicles: 3,
        ..EnvConfig::default()
    };
    let make = || isodream_envs::make(&config).unwrap();
    let served = Served::environments((0..3).map(|_| make()).collect());
    let remote = RemoteEnvironment::connect_all(&served.address, options(PATIENT)).unwrap();
    let boxed = remote
        .into_iter()
        .map(|env| Box::new(env) as Box<dyn Environment>);
    let mut remote = VectorEnvironment::new(boxed.collect(), 5, TWO).unwrap();
    let mut local = VectorEnvironment::new((0..3).map(|_| make()).collect(), 5, TWO).unwrap();
    assert_eq!(remote.len(), 3);
    assert_eq!(remote.reset(), local.reset());
    for step in 0..7 {
        let actions = [0.0, 1.0, 0.1 * step as f32, 0.5, -0.2, 0.9];
        assert_eq!(remote.step(&actions), local.step(&actions), "step {step}");
    }
}

#[test]
fn rows_that_make_no_sense_are_refused_and_a_reset_goes_on() {
    for (act, words) in [
        (Act::NanReward, "the reward is NaN"),
        (Act::ShortImage, "the image has 7 bytes, 2x3x3 need 18"),
    ] {
        let served = Served::environments(vec![World::boxed(act)]);
        let mut env = served.connect(PATIENT);
        two_steps(&mut env);
        let error = env.step(&[0.0; 2]).unwrap_err();
        assert!(
            matches!(error, EnvError::InvalidTransition { step: 3, .. }),
            "{error}"
        );
        assert!(error.to_string().contains(words), "{error}");
        assert_eq!(env.step(&[0.0; 2]), Err(EnvError::NotReset));
        two_steps(&mut env);
    }
}

#[test]
fn errors_and_panics_over_there_are_reported_and_a_reset_goes_on() {
    for (act, words) in [(Act::Fail, "episode is over"), (Act::Panic, "panicked")] {
        let served = Served::environments(vec![World::boxed(act)]);
        let mut env = served.connect(PATIENT);
        two_steps(&mut env);
        let error = env.step(&[0.0; 2]).unwrap_err();
        let EnvError::Remote {
            address,
            fault: RemoteFault::Failed(reason),
        } = &error
        else {
            panic!("{error}");
        };
        assert_eq!(*address, served.address);
        assert!(reason.contains(words), "{reason}");
        two_steps(&mut env);
    }
}

#[test]
fn a_hanging_environment_meets_the_deadline_and_a_reset_connects_again() {
    let served = Served::environments(vec![World::boxed(Act::Hang(2 * SHORT))]);
    let mut env = served.connect(SHORT);
    two_steps(&mut env);
    let error = env.step(&[0.0; 2]).unwrap_err();
    let deadline = |fault: &RemoteFault| *fault == RemoteFault::Deadline(SHORT);
    assert!(
        matches!(&error, EnvError::Remote { fault, .. } if deadline(fault)),
        "{error}"
    );
    let connected = (0..20).any(|_| env.reset(1).is_ok());
    assert!(
        connected,
        "the environment must have woken up, no reset reaches it"
    );
    env.step(&[0.0; 2]).unwrap();
}

#[test]
fn a_killed_server_is_lost_at_once_and_found_again_after_its_restart() {
    let served = Served::environments(vec![World::boxed(Act::Nothing)]);
    let mut env = served.connect(PATIENT);
    two_steps(&mut env);
    let address = served.kill();
    let before = Instant::now();
    let error = env.step(&[0.0; 2]).unwrap_err();
    assert!(before.elapsed() < PATIENT / 2, "{:?}", before.elapsed());
    assert!(
        matches!(
            &error,
            EnvError::Remote {
                fault: RemoteFault::Lost(_),
                ..
            }
        ),
        "{error}"
    );
    assert!(error.to_string().contains(&address), "{error}");

    let _served = Served::environments_at(&address, vec![World::boxed(Act::Nothing)]);
    two_steps(&mut env);
}

#[test]
fn a_server_that_changed_its_spec_is_refused() {
    let served = Served::environments(vec![World::boxed(Act::Nothing)]);
    let mut env = served.connect(PATIENT);
    env.reset(1).unwrap();
    let address = served.kill();
    assert!(env.step(&[0.0; 2]).is_err());
    let two = vec![World::boxed(Act::Nothing), World::boxed(Act::Nothing)];
    let _served = Served::environments_at(&address, two);
    let error = env.reset(1).unwrap_err();
    assert!(
        error.to_string().contains("now offers 2 x test/world"),
        "{error}"
    );
}

#[test]
fn nobody_there_and_impossible_addresses_are_named() {
    let free = Served::environments(vec![World::boxed(Act::Nothing)]).kill();
    for (address, words) in [(free.as_str(), "connection lost"), ("nowhere", "host:port")] {
        let error = RemoteEnvironment::connect(address, options(PATIENT))
            .err()
            .unwrap();
        assert!(error.to_string().contains(words), "{error}");
        assert!(error.to_string().contains(address), "{error}");
    }
}

#[test]
fn a_second_client_is_kept_out_until_the_first_has_left() {
    let served = Served::environments(vec![World::boxed(Act::Nothing)]);
    let first = served.connect(PATIENT);
    let second = RemoteEnvironment::connect(&served.address, options(PATIENT));
    let error = second.err().unwrap().to_string();
    assert!(
        error.contains("another client drives these environments"),
        "{error}"
    );
    drop(first);
    let connects = |_| RemoteEnvironment::connect(&served.address, options(PATIENT)).is_ok();
    let waited = (0..200).any(|attempt| {
        std::thread::sleep(Duration::from_millis(10));
        connects(attempt)
    });
    assert!(waited, "the first client's place is never free");
}

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
        (with(|it| it.environments = 0), "offers 0 environments"),
        (
            with(|it| it.spec.as_mut().unwrap().height = 0),
            "0x3x3 is not possible",
        ),
        (None, "no answer within 400ms"),
    ] {
        let served = Served::odd(OddServer {
            welcome,
            answer: None,
        });
        let error = RemoteEnvironment::connect(&served.address, options(SHORT))
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
        let served = Served::odd(OddServer {
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

#[tokio::test(flavor = "multi_thread")]
async fn a_client_works_on_another_runtimes_threads() {
    // Blocking on a second runtime would panic there.
    let served = Served::environments(vec![World::boxed(Act::Nothing)]);
    let mut env = served.connect(PATIENT);
    env.reset(1).unwrap();
    assert_eq!(env.step(&[0.25, 0.5]).unwrap().reward, 0.75);
}
