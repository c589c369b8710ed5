//! The service that lets other processes drive our environments.

use std::num::NonZeroUsize;
use std::sync::Arc;

use isodream_core::EnvSpec;
use isodream_envs::{EnvError, Environment};
use isodream_proto::v1::environment_request::Kind;
use isodream_proto::v1::environment_service_server::{
    EnvironmentService, EnvironmentServiceServer,
};
use isodream_proto::v1::{EnvironmentReply, EnvironmentRequest};
use isodream_proto::{Mismatch, PROTOCOL_VERSION};
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use super::session::Session;
use super::stock::Stock;
use crate::limits::{HELLO_TIMEOUT, MAX_MESSAGE_BYTES};
use crate::{Door, RpcError, ServiceError};

/// Environments that are alike, each for one client at a time.
pub struct EnvironmentServer {
    worlds: Arc<Worlds>,
}

/// What all sessions share.
pub(super) struct Worlds {
    pub(super) spec: EnvSpec,
    pub(super) stock: Arc<Stock>,
    /// As many commands as may run at once.
    pub(super) threads: Arc<Semaphore>,
}

impl EnvironmentServer {
    /// A server for `environments`, which carries out at most `threads` commands at once.
    ///
    /// # Errors
    /// If there is no environment, or if their specs differ.
    pub fn new(
        environments: Vec<Box<dyn Environment>>,
        threads: NonZeroUsize,
    ) -> Result<Self, EnvError> {
        let spec = isodream_envs::common_spec(&environments)?;
        Ok(Self {
            worlds: Arc::new(Worlds {
                spec,
                stock: Arc::new(Stock::new(environments)),
                threads: Arc::new(Semaphore::new(threads.get().min(Semaphore::MAX_PERMITS))),
            }),
        })
    }

    /// Serves on `listener` behind `door` until `shutdown` is cancelled, beside a health service.
    ///
    /// # Errors
    /// [`RpcError::Serve`] where the server fails, [`RpcError::Tls`] where the door's certificates make no sense.
    pub async fn serve(
        self,
        listener: TcpListener,
        door: Door,
        shutdown: CancellationToken,
    ) -> Result<(), RpcError> {
        let router = crate::server(&door)?
            .add_service(crate::serving::<EnvironmentServiceServer<Self>>().await)
            .add_service(self.service());
        crate::serve(router, listener, shutdown).await
    }

    fn service(self) -> EnvironmentServiceServer<Self> {
        EnvironmentServiceServer::new(self)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES)
    }
}

#[tonic::async_trait]
impl EnvironmentService for EnvironmentServer {
    type RunStream = ReceiverStream<Result<EnvironmentReply, Status>>;

    async fn run(
        &self,
        request: Request<Streaming<EnvironmentRequest>>,
    ) -> Result<Response<Self::RunStream>, Status> {
        let peer = request.remote_addr();
        let mut requests = request.into_inner();
        let first = tokio::time::timeout(HELLO_TIMEOUT, requests.message())
            .await
            .map_err(|_| ServiceError::Unavailable("no greeting came in time".to_owned()))??;
        let Some(Kind::Hello(hello)) = first.and_then(|request| request.kind) else {
            return Err(ServiceError::from(Mismatch::Missing).into());
        };
        if hello.protocol_version != PROTOCOL_VERSION {
            let mismatch = Mismatch::Protocol {
                ours: PROTOCOL_VERSION,
                theirs: hello.protocol_version,
            };
            tracing::warn!(?peer, %mismatch, "refused a client");
            return Err(ServiceError::from(mismatch).into());
        }
        let wanted = hello.environments as usize;
        let lease = self.worlds.stock.lease(wanted).map_err(|free| {
            ServiceError::Unavailable(format!(
                "{wanted} environments were asked for and {free} of {} are free, the others are driven by other clients; \
                 serve more of them or try again later",
                self.worlds.stock.len()
            ))
        })?;
        tracing::info!(?peer, environments = wanted, "client connected");
        let session = Session::new(self.worlds.clone(), hello.segmentation, lease);
        Ok(Response::new(ReceiverStream::new(session.start(requests))))
    }
}
