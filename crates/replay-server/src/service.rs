//! The gRPC service: handshakes here, streams in their own tasks.

use std::sync::Arc;

use isodream_proto::v1::replay_service_server::ReplayService;
use isodream_proto::v1::{
    AppendReply, AppendRequest, Handshake, Hello, ReplayStatus, ReplayStatusRequest, SampleHello,
    SampleReply, SampleRequest, append_request, sample_request,
};
use isodream_proto::{Identity, Mismatch};
use isodream_replay::{MAX_ACTOR_ID_BYTES, StoreIdentity};
use isodream_rpc::ServiceError;
use isodream_rpc::limits::HELLO_TIMEOUT;
use tokio::sync::oneshot;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use crate::commit::{Command, Position, answered};
use crate::errors::service_error;
use crate::sample::Drawer;
use crate::state::{Reign, State};
use crate::{append, sample};

pub(crate) struct ReplayServer {
    state: Arc<State>,
}

impl ReplayServer {
    pub(crate) fn new(state: Arc<State>) -> Self {
        Self { state }
    }

    /// Accepts a peer that belongs to the store; the first one decides what that is.
    async fn check(&self, handshake: Option<&Handshake>) -> Result<(), ServiceError> {
        let peer = handshake.ok_or(Mismatch::Missing)?;
        let theirs = Identity {
            env_spec_hash: peer.env_spec_hash.clone(),
            env_spec: peer.env_spec.clone(),
            model_hash: String::new(),
        };
        // Only the protocol version can differ here: an outdated peer must not decide the store's identity.
        theirs.check(handshake)?;
        if theirs.env_spec_hash.is_empty() || theirs.env_spec_hash.contains('\n') {
            return Err(ServiceError::Invalid(
                "the handshake names no environment; connect with an isodream client".to_owned(),
            ));
        }
        let (answer, stored) = oneshot::channel();
        let offered = StoreIdentity {
            env_spec_hash: theirs.env_spec_hash,
            env_spec: theirs.env_spec,
        };
        self.state
            .command(Command::Identity { offered, answer })
            .await?;
        let stored = answered(stored).await?;
        let ours = Identity {
            env_spec_hash: stored.env_spec_hash,
            env_spec: stored.env_spec,
            model_hash: String::new(),
        };
        Ok(ours.check(handshake)?)
    }

    async fn begin(&self, hello: &Hello) -> Result<Position, ServiceError> {
        // First: who meant another store is neither refused by this one nor decides what it belongs to.
        self.state.check_store(&hello.store_id)?;
        self.check(hello.handshake.as_ref()).await?;
        let (answer, position) = oneshot::channel();
        let hello = hello.clone();
        self.state.command(Command::Begin { hello, answer }).await?;
        answered(position).await
    }

    async fn drawer(&self, hello: &SampleHello) -> Result<(Drawer, Reign), ServiceError> {
        self.state.check_store(&hello.store_id)?;
        self.check(hello.handshake.as_ref()).await?;
        let served = self.state.tables.find(&hello.table)?;
        let (store, table) = (self.state.store.clone(), served.table.clone());
        let (length, seed) = (hello.sequence_length, hello.seed);
        // The first sampler of its kind goes through all that is held.
        let sampler = tokio::task::spawn_blocking(move || store.sampler(&table, length, seed))
            .await
            .map_err(|error| ServiceError::Internal(format!("preparing a table failed: {error}")))?
            .map_err(|error| service_error(&error))?;
        let limited = served.limited;
        let reign = match limited {
            true => {
                let (epoch, sampled) = (hello.learner_epoch, hello.sampled_steps);
                self.state.learner_connected(epoch, &sampler, sampled)?
            }
            false => self.state.admit_learner(0)?,
        };
        Ok((Drawer { sampler, limited }, reign))
    }
}

/// A stream's first message, within its deadline.
async fn first<T>(requests: &mut Streaming<T>) -> Result<T, Status> {
    tokio::time::timeout(HELLO_TIMEOUT, requests.message())
        .await
        .map_err(|_| ServiceError::Unavailable(format!("no hello came within {HELLO_TIMEOUT:?}")))??
        .ok_or_else(|| {
            ServiceError::Unavailable("the stream ended before its hello".to_owned()).into()
        })
}

#[tonic::async_trait]
impl ReplayService for ReplayServer {
    type AppendStream = ReceiverStream<Result<AppendReply, Status>>;
    type SampleStream = ReceiverStream<Result<SampleReply, Status>>;

    async fn append(
        &self,
        request: Request<Streaming<AppendRequest>>,
    ) -> Result<Response<Self::AppendStream>, Status> {
        let peer = request.remote_addr();
        let mut requests = request.into_inner();
        let Some(append_request::Kind::Hello(hello)) = first(&mut requests).await?.kind else {
            return Err(ServiceError::from(Mismatch::Missing).into());
        };
        let position = self.begin(&hello).await.inspect_err(|error| {
            // As much of its name as a store would take.
            let actor = &hello.actor_id[..hello.actor_id.floor_char_boundary(MAX_ACTOR_ID_BYTES)];
            tracing::warn!(actor, epoch = hello.epoch, ?peer, %error, "refused an actor");
        })?;
        let Position { epoch, next_seq } = position;
        tracing::info!(actor = %hello.actor_id, epoch, next_seq, ?peer, "actor connected");
        let replies = append::start(self.state.clone(), requests, position, hello.actor_id);
        Ok(Response::new(ReceiverStream::new(replies)))
    }

    async fn sample(
        &self,
        request: Request<Streaming<SampleRequest>>,
    ) -> Result<Response<Self::SampleStream>, Status> {
        let peer = request.remote_addr();
        let mut requests = request.into_inner();
        let Some(sample_request::Kind::Hello(hello)) = first(&mut requests).await?.kind else {
            return Err(ServiceError::from(Mismatch::Missing).into());
        };
        let (drawer, reign) = self.drawer(&hello).await.inspect_err(|error| {
            tracing::warn!(?peer, %error, "refused a learner");
        })?;
        tracing::info!(
            ?peer,
            table = %hello.table,
            sequence_length = hello.sequence_length,
            sampled_steps = hello.sampled_steps,
            "learner connected"
        );
        let replies = sample::start(
            self.state.clone(),
            requests,
            drawer,
            reign,
            hello.waiting_credits,
        );
        Ok(Response::new(ReceiverStream::new(replies)))
    }

    async fn status(
        &self,
        _request: Request<ReplayStatusRequest>,
    ) -> Result<Response<ReplayStatus>, Status> {
        Ok(Response::new(self.state.status()))
    }
}
