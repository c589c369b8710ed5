//! One client's stream of commands.

use std::sync::Arc;

use isodream_envs::Environment;
use isodream_proto::PROTOCOL_VERSION;
use isodream_proto::v1::environment_command::Kind as Command;
use isodream_proto::v1::environment_reply::Kind as Reply;
use isodream_proto::v1::environment_request::Kind;
use isodream_proto::v1::environment_result::Kind as Outcome;
use isodream_proto::v1::{
    EnvironmentBatch, EnvironmentReply, EnvironmentRequest, EnvironmentResult, EnvironmentResults,
    EnvironmentWelcome,
};
use tokio::sync::{OwnedMutexGuard, mpsc};
use tonic::{Status, Streaming};

use super::convert::{row_message, spec_message};
use super::server::Worlds;
use super::stock::Lease;
use crate::{ServiceError, is_refusal};

type Replies = mpsc::Sender<Result<EnvironmentReply, Status>>;

pub(super) struct Session {
    worlds: Arc<Worlds>,
    segmentation: bool,
    /// Held for as long as this session lives or one of its commands runs.
    lease: Arc<Lease>,
}

impl Session {
    pub(super) fn new(worlds: Arc<Worlds>, segmentation: bool, lease: Lease) -> Self {
        Self {
            worlds,
            segmentation,
            lease: Arc::new(lease),
        }
    }

    /// Answers `requests` in a task of its own, beginning with the welcome.
    pub(super) fn start(
        self,
        mut requests: Streaming<EnvironmentRequest>,
    ) -> mpsc::Receiver<Result<EnvironmentReply, Status>> {
        // Every environment has at most one command under way.
        let (replies, answers) = mpsc::channel(self.lease.environments().len() + 1);
        tokio::spawn(async move {
            let ended = self.run(&mut requests, &replies).await;
            if let Err(status) = ended {
                tracing::warn!(error = %status, "client's stream ended");
                // A client that is gone needs no status.
                let _ = replies.send(Err(status)).await;
            }
        });
        answers
    }

    async fn run(
        &self,
        requests: &mut Streaming<EnvironmentRequest>,
        replies: &Replies,
    ) -> Result<(), Status> {
        let welcome = EnvironmentWelcome {
            protocol_version: PROTOCOL_VERSION,
            spec: Some(spec_message(&self.worlds.spec)),
            environments: self.lease.environments().len() as u32,
        };
        let _ = replies.send(Ok(reply(Reply::Welcome(welcome)))).await;
        loop {
            let request = tokio::select! {
                request = requests.message() => match request {
                    Ok(request) => request,
                    Err(status) if is_refusal(&status) => return Err(status),
                    Err(status) => {
                        tracing::info!(error = status.message(), "client's connection broke");
                        None
                    }
                },
                () = replies.closed() => None,
            };
            match request.map(|request| request.kind) {
                None => return Ok(()),
                Some(Some(Kind::Batch(batch))) => self.begin(batch, replies)?,
                Some(_) => {
                    let reason = "a batch of commands was expected".to_owned();
                    return Err(ServiceError::Invalid(reason).into());
                }
            }
        }
    }

    /// Takes the environments of `batch` and answers from another task.
    fn begin(&self, batch: EnvironmentBatch, replies: &Replies) -> Result<(), ServiceError> {
        if batch.commands.is_empty() {
            return Err(ServiceError::Invalid("the batch is empty".to_owned()));
        }
        let mut running = Vec::with_capacity(batch.commands.len());
        for command in batch.commands {
            let index = command.environment;
            let invalid = |why: &str| ServiceError::Invalid(format!("environment {index} {why}"));
            let env = self.lease.environments().get(index as usize);
            let env = env.ok_or_else(|| invalid("does not exist"))?;
            let env = env.clone().try_lock_owned();
            let env = env.map_err(|_| invalid("is busy with an earlier command"))?;
            let kind = command
                .kind
                .ok_or_else(|| invalid("got an empty command"))?;
            running.push((index, self.obey(env, kind)));
        }
        let (number, replies) = (batch.number, replies.clone());
        tokio::spawn(async move {
            let mut results = Vec::with_capacity(running.len());
            for (environment, outcome) in running {
                let outcome = outcome.await.unwrap_or_else(|error| {
                    tracing::error!(environment, %error, "environment panicked");
                    Outcome::Error("the environment panicked".to_owned())
                });
                results.push(EnvironmentResult {
                    environment,
                    kind: Some(outcome),
                });
            }
            let results = EnvironmentResults { number, results };
            let _ = replies.send(Ok(reply(Reply::Results(results)))).await;
        });
        Ok(())
    }

    fn obey(
        &self,
        mut env: OwnedMutexGuard<Box<dyn Environment>>,
        command: Command,
    ) -> tokio::task::JoinHandle<Outcome> {
        let (threads, segmentation) = (self.worlds.threads.clone(), self.segmentation);
        let lease = self.lease.clone();
        tokio::spawn(async move {
            let _lease = lease;
            // The semaphore is never closed.
            let _turn = threads.acquire_owned().await;
            let carried_out = tokio::task::spawn_blocking(move || {
                let row = match command {
                    Command::Reset(reset) => env.reset(reset.seed),
                    Command::Step(step) => env.step(&step.action),
                };
                match row {
                    Ok(row) => Outcome::Row(row_message(row, env.as_ref(), segmentation)),
                    Err(error) => Outcome::Error(error.to_string()),
                }
            });
            carried_out.await.unwrap_or_else(|error| {
                tracing::error!(%error, "environment panicked");
                Outcome::Error("the environment panicked".to_owned())
            })
        })
    }
}

fn reply(kind: Reply) -> EnvironmentReply {
    EnvironmentReply { kind: Some(kind) }
}
