//! What servers say of themselves, asked from here or from inside a network namespace.

use std::fs::File;
use std::os::fd::AsFd;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use isodream_proto::v1;
use isodream_rpc::Dialer;
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};
use tokio::runtime::{Builder, Runtime};

/// How long an answer may take.
const PATIENCE: Duration = Duration::from_millis(1500);

/// Asks servers for their status.
#[derive(Debug, Clone)]
pub(crate) struct Probe {
    runtime: Arc<Runtime>,
    dialer: Dialer,
}

impl Probe {
    /// A probe in this process's network, or in the namespace whose file is `namespace`.
    pub(crate) fn new(namespace: Option<&Path>, dialer: Dialer) -> Result<Self> {
        let file = match namespace {
            Some(path) => {
                Some(File::open(path).with_context(|| format!("cannot open {}", path.display()))?)
            }
            None => None,
        };
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .on_thread_start(move || {
                if let Some(file) = &file
                    && let Err(error) =
                        move_into_link_name_space(file.as_fd(), Some(LinkNameSpaceType::Network))
                {
                    // Answers would come from the wrong network.
                    eprintln!("cannot enter a network namespace: {error}");
                    std::process::abort();
                }
            })
            .build()?;
        Ok(Self {
            runtime: Arc::new(runtime),
            dialer,
        })
    }

    /// Runs `future` on the probe's own threads, which alone are in its network.
    pub(crate) fn run<T: Send + 'static>(
        &self,
        future: impl Future<Output = T> + Send + 'static,
    ) -> Result<T> {
        let task = self.runtime.spawn(future);
        self.runtime.block_on(task).context("a request died")
    }

    /// [`Probe::run`] that gives up after a while.
    fn ask<T: Send + 'static>(
        &self,
        future: impl Future<Output = Option<T>> + Send + 'static,
    ) -> Option<T> {
        let answer = self.run(async { tokio::time::timeout(PATIENCE, future).await.ok() });
        answer.ok().flatten().flatten()
    }

    /// The learner's status; none while it is away.
    pub(crate) fn learner(&self, address: &str) -> Option<v1::LearnerStatus> {
        let (dialer, address) = (self.dialer.clone(), address.to_owned());
        self.ask(async move {
            let mut client = dialer.learner(&address).ok()?;
            let status = client.status(v1::LearnerStatusRequest {}).await;
            Some(status.ok()?.into_inner())
        })
    }

    /// A replay-server's status; none while it is away.
    pub(crate) fn replay(&self, address: &str) -> Option<v1::ReplayStatus> {
        let (dialer, address) = (self.dialer.clone(), address.to_owned());
        self.ask(async move {
            let mut client = dialer.replay(&address).ok()?;
            let status = client.status(v1::ReplayStatusRequest {}).await;
            Some(status.ok()?.into_inner())
        })
    }
}
