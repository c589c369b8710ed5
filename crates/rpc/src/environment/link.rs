//! A connection to environments in another process.

use std::collections::HashMap;
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use isodream_core::EnvSpec;
use isodream_envs::RemoteFault;
use isodream_proto::v1::environment_command::Kind as Command;
use isodream_proto::v1::environment_reply::Kind as Reply;
use isodream_proto::v1::environment_request::Kind;
use isodream_proto::v1::environment_result::Kind as Outcome;
use isodream_proto::v1::{
    EnvironmentBatch, EnvironmentCommand, EnvironmentHello, EnvironmentReply, EnvironmentRequest,
    EnvironmentResults, EnvironmentRow, EnvironmentWelcome,
};
use isodream_proto::{Mismatch, PROTOCOL_VERSION};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::{Status, Streaming};

use super::RemoteOptions;
use super::convert;
use crate::error::words;
use crate::{Dialer, is_refusal};

/// One stream, driven by a thread with a runtime of its own: environments are synchronous, and may be used
/// inside and outside of other runtimes.
pub(super) struct Link {
    pub(super) spec: EnvSpec,
    requests: mpsc::Sender<EnvironmentRequest>,
    waiting: Arc<Mutex<Waiting>>,
    deadline: Duration,
    /// Ends the thread, also while the peer hangs.
    stop: DropGuard,
}

/// Who waits for which batch, until the stream ends.
#[derive(Default)]
struct Waiting {
    batches: HashMap<u64, SyncSender<Result<EnvironmentResults, RemoteFault>>>,
    next_number: u64,
    ended: Option<RemoteFault>,
}

impl Link {
    /// Connects, and has `environments` reserved.
    pub(super) fn open(
        dialer: &Dialer,
        address: &str,
        environments: u32,
        options: RemoteOptions,
    ) -> Result<Self, RemoteFault> {
        let RemoteOptions {
            deadline,
            segmentation,
        } = options;
        let (greeted, greeting) = sync_channel(1);
        let waiting = Arc::new(Mutex::new(Waiting::default()));
        let stop = CancellationToken::new().drop_guard();
        let stopped = stop.token().clone();
        let (requests, outbound) = mpsc::channel(environments as usize + 2);
        let hello = EnvironmentHello {
            protocol_version: PROTOCOL_VERSION,
            segmentation,
            environments,
        };
        let _ = requests.try_send(request(Kind::Hello(hello)));
        let driver = Driver {
            dialer: dialer.clone(),
            address: address.to_owned(),
            outbound,
            waiting: waiting.clone(),
        };
        let lost = |error: std::io::Error| RemoteFault::Lost(error.to_string());
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(lost)?;
        std::thread::Builder::new()
            .name("remote-env".to_owned())
            .spawn(move || {
                let shared = driver.waiting.clone();
                let ended = runtime.block_on(async {
                    tokio::select! {
                        ended = driver.run(&greeted) => ended,
                        () = stopped.cancelled() => RemoteFault::Lost("it was closed here".to_owned()),
                    }
                });
                let _ = greeted.try_send(Err(ended.clone()));
                let mut waiting = lock(&shared);
                for (_, waiter) in waiting.batches.drain() {
                    let _ = waiter.try_send(Err(ended.clone()));
                }
                waiting.ended = Some(ended);
            })
            .map_err(lost)?;
        let welcome = greeting
            .recv_timeout(deadline)
            .map_err(|_| RemoteFault::Deadline(deadline))??;
        Ok(Self {
            spec: accept(&welcome, environments)?,
            requests,
            waiting,
            deadline,
            stop,
        })
    }

    /// Whether the stream still runs.
    pub(super) fn is_open(&self) -> bool {
        lock(&self.waiting).ended.is_none()
    }

    /// Ends the stream, whoever else holds this.
    pub(super) fn close(&self) {
        self.stop.token().cancel();
    }

    /// Has `environment` carry out `command`. A deadline that passes ends the stream, since nobody knows what
    /// the environment then does.
    pub(super) fn command(
        &self,
        environment: u32,
        command: Command,
    ) -> Result<EnvironmentRow, RemoteFault> {
        let (answered, answer) = sync_channel(1);
        let number = {
            let mut waiting = lock(&self.waiting);
            if let Some(fault) = &waiting.ended {
                return Err(fault.clone());
            }
            waiting.next_number += 1;
            let number = waiting.next_number;
            waiting.batches.insert(number, answered);
            number
        };
        let batch = EnvironmentBatch {
            number,
            commands: vec![EnvironmentCommand {
                environment,
                kind: Some(command),
            }],
        };
        let results = match self.requests.try_send(request(Kind::Batch(batch))) {
            Ok(()) => answer.recv_timeout(self.deadline),
            // The stream ended meanwhile, and has told or will tell why.
            Err(_) => answer.recv_timeout(Duration::from_secs(1)),
        };
        let results = results.unwrap_or_else(|error| {
            let fault = match error {
                RecvTimeoutError::Timeout => RemoteFault::Deadline(self.deadline),
                RecvTimeoutError::Disconnected => RemoteFault::Lost("the stream ended".to_owned()),
            };
            lock(&self.waiting).ended = Some(fault.clone());
            Err(fault)
        })?;
        let [result] = results.results.as_slice() else {
            return Err(RemoteFault::Protocol(format!(
                "{} results came for one command",
                results.results.len()
            )));
        };
        if result.environment != environment {
            return Err(RemoteFault::Protocol(format!(
                "environment {} answered for {environment}",
                result.environment
            )));
        }
        match &result.kind {
            Some(Outcome::Row(row)) => Ok(row.clone()),
            Some(Outcome::Error(error)) => Err(RemoteFault::Failed(error.clone())),
            None => Err(RemoteFault::Protocol("a result is empty".to_owned())),
        }
    }
}

/// What the thread works on.
struct Driver {
    dialer: Dialer,
    address: String,
    outbound: mpsc::Receiver<EnvironmentRequest>,
    waiting: Arc<Mutex<Waiting>>,
}

impl Driver {
    /// Runs until the stream ends, and says why it did.
    async fn run(
        self,
        greeted: &SyncSender<Result<EnvironmentWelcome, RemoteFault>>,
    ) -> RemoteFault {
        let mut client = match self.dialer.environment(&self.address) {
            Ok(client) => client,
            Err(error) => return RemoteFault::Refused(error.to_string()),
        };
        let mut replies = match client.run(ReceiverStream::new(self.outbound)).await {
            Ok(replies) => replies.into_inner(),
            Err(status) => return fault(&status),
        };
        match next(&mut replies).await {
            Ok(Reply::Welcome(welcome)) => {
                let _ = greeted.try_send(Ok(welcome));
            }
            Ok(Reply::Results(_)) => {
                return RemoteFault::Protocol("results came before the welcome".to_owned());
            }
            Err(fault) => return fault,
        }
        loop {
            match next(&mut replies).await {
                Ok(Reply::Results(results)) => {
                    let waiter = lock(&self.waiting).batches.remove(&results.number);
                    let Some(waiter) = waiter else {
                        return RemoteFault::Protocol(format!(
                            "results came for batch {}, which nobody waits for",
                            results.number
                        ));
                    };
                    let _ = waiter.try_send(Ok(results));
                }
                Ok(Reply::Welcome(_)) => {
                    return RemoteFault::Protocol("a second welcome came".to_owned());
                }
                Err(fault) => return fault,
            }
        }
    }
}

async fn next(replies: &mut Streaming<EnvironmentReply>) -> Result<Reply, RemoteFault> {
    match replies.message().await {
        Ok(Some(EnvironmentReply { kind: Some(kind) })) => Ok(kind),
        Ok(Some(_)) => Err(RemoteFault::Protocol("a reply is empty".to_owned())),
        Ok(None) => Err(RemoteFault::Lost("it closed the stream".to_owned())),
        Err(status) => Err(fault(&status)),
    }
}

fn fault(status: &Status) -> RemoteFault {
    if is_refusal(status) {
        RemoteFault::Refused(words(status))
    } else {
        RemoteFault::Lost(words(status))
    }
}

/// What the peer offers, if it makes sense.
fn accept(welcome: &EnvironmentWelcome, asked: u32) -> Result<EnvSpec, RemoteFault> {
    if welcome.protocol_version != PROTOCOL_VERSION {
        let mismatch = Mismatch::Protocol {
            ours: PROTOCOL_VERSION,
            theirs: welcome.protocol_version,
        };
        return Err(RemoteFault::Refused(mismatch.to_string()));
    }
    let missing = || RemoteFault::Protocol("the welcome names no spec".to_owned());
    let spec = convert::spec(welcome.spec.as_ref().ok_or_else(missing)?)
        .map_err(|error| RemoteFault::Protocol(error.to_string()))?;
    let offered = welcome.environments;
    if offered != asked {
        return Err(RemoteFault::Protocol(format!(
            "it offers {offered} environments where {asked} were asked for"
        )));
    }
    Ok(spec)
}

fn request(kind: Kind) -> EnvironmentRequest {
    EnvironmentRequest { kind: Some(kind) }
}

fn lock(waiting: &Mutex<Waiting>) -> MutexGuard<'_, Waiting> {
    waiting.lock().unwrap_or_else(PoisonError::into_inner)
}
