//! A server in this process, and a world that misbehaves on request.

use std::num::NonZeroUsize;
use std::time::Duration;

use isodream_core::{EnvSpec, ImageShape};
use isodream_envs::{EndReason, EnvError, Environment, PrivilegedView, Transition};
use isodream_rpc::{EnvironmentServer, RemoteEnvironment, RemoteOptions, bind};
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

pub(crate) const TWO: NonZeroUsize = NonZeroUsize::new(2).unwrap();

/// A server in this process that ends with the value.
pub(crate) struct Served {
    pub(crate) address: String,
    shutdown: CancellationToken,
    runtime: Option<Runtime>,
}

impl Served {
    pub(crate) fn environments(environments: Vec<Box<dyn Environment>>) -> Self {
        Self::environments_at("127.0.0.1:0", environments)
    }

    pub(crate) fn environments_at(address: &str, environments: Vec<Box<dyn Environment>>) -> Self {
        let service = EnvironmentServer::new(environments, TWO).unwrap();
        Self::start(address, |listener, shutdown| {
            service.serve(listener, isodream_rpc::Door::default(), shutdown)
        })
    }

    pub(crate) fn start<F>(
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
                    .spawn(|| runtime.block_on(bind(address, &isodream_rpc::Door::default())))
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
    pub(crate) fn kill(mut self) -> String {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
        self.address.clone()
    }

    pub(crate) fn connect(&self, deadline: Duration) -> RemoteEnvironment {
        RemoteEnvironment::connect(
            &isodream_rpc::Dialer::default(),
            &self.address,
            options(deadline),
        )
        .unwrap()
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

pub(crate) fn options(deadline: Duration) -> RemoteOptions {
    RemoteOptions {
        deadline,
        ..RemoteOptions::default()
    }
}

pub(crate) const PATIENT: Duration = Duration::from_secs(20);
pub(crate) const SHORT: Duration = Duration::from_millis(400);

/// What a [`World`] does at its third step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Act {
    Nothing,
    Hang(Duration),
    NanReward,
    ShortImage,
    Fail,
    Panic,
}

/// A world of 2 x 3 pixels.
pub(crate) struct World {
    spec: EnvSpec,
    act: Act,
    step: u8,
}

impl World {
    pub(crate) fn boxed(act: Act) -> Box<dyn Environment> {
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
