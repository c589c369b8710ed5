//! The skeleton of every server.

use std::net::SocketAddr;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::server::NamedService;
use tonic::transport::Server;
use tonic::transport::server::{Connected, Router, TcpIncoming};
use tonic_health::pb::health_server::{Health, HealthServer};

use crate::RpcError;
use crate::limits::{
    CONNECTION_WINDOW_BYTES, KEEPALIVE_INTERVAL, KEEPALIVE_TIMEOUT, MAX_FRAME_BYTES,
    SHUTDOWN_GRACE, STREAM_WINDOW_BYTES,
};

/// A connection that a server can serve.
pub trait Connection: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static {}

impl<C: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static> Connection for C {}

/// Listens on `address` (`host:port`; port 0 takes a free one).
///
/// # Errors
/// [`RpcError::InUse`] where another process listens, [`RpcError::Listen`] for everything else.
pub async fn bind(address: &str) -> Result<TcpListener, RpcError> {
    let failed = |error: std::io::Error| RpcError::Listen {
        address: address.to_owned(),
        reason: error.to_string(),
    };
    let resolved: Vec<SocketAddr> = tokio::net::lookup_host(address)
        .await
        .map_err(failed)?
        .collect();
    match TcpListener::bind(resolved.as_slice()).await {
        Ok(listener) => Ok(listener),
        Err(error) if error.kind() == std::io::ErrorKind::AddrInUse => match resolved.last() {
            Some(&address) => Err(RpcError::InUse { address }),
            None => Err(failed(error)),
        },
        Err(error) => Err(failed(error)),
    }
}

/// A server builder with this project's limits. Services set their message caps to
/// [`crate::limits::MAX_MESSAGE_BYTES`] themselves.
pub fn server() -> Server {
    Server::builder()
        .http2_keepalive_interval(Some(KEEPALIVE_INTERVAL))
        .http2_keepalive_timeout(Some(KEEPALIVE_TIMEOUT))
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .max_frame_size(MAX_FRAME_BYTES)
}

/// A health service that reports the service `S` as serving.
pub async fn serving<S: NamedService>() -> HealthServer<impl Health> {
    let (reporter, service) = tonic_health::server::health_reporter();
    reporter.set_serving::<S>().await;
    service
}

/// Serves until `shutdown` is cancelled, then gives open streams [`SHUTDOWN_GRACE`] to end.
///
/// # Errors
/// [`RpcError::Serve`] where the server fails.
pub async fn serve(
    router: Router,
    listener: TcpListener,
    shutdown: CancellationToken,
) -> Result<(), RpcError> {
    let incoming = TcpIncoming::from(listener).with_nodelay(Some(true));
    serve_connections(router, incoming, shutdown).await
}

/// [`serve`] for connections from anywhere, for example a simulated network.
///
/// # Errors
/// [`RpcError::Serve`] where the server fails.
pub async fn serve_connections<C: Connection>(
    router: Router,
    incoming: impl Stream<Item = std::io::Result<C>>,
    shutdown: CancellationToken,
) -> Result<(), RpcError> {
    serve_within(router, incoming, shutdown, SHUTDOWN_GRACE).await
}

async fn serve_within<C: Connection>(
    router: Router,
    incoming: impl Stream<Item = std::io::Result<C>>,
    shutdown: CancellationToken,
    grace: Duration,
) -> Result<(), RpcError> {
    let serving = router.serve_with_incoming_shutdown(incoming, shutdown.clone().cancelled_owned());
    let overdue = async {
        shutdown.cancelled().await;
        tokio::time::sleep(grace).await;
    };
    tokio::select! {
        result = serving => result.map_err(|error| RpcError::Serve(error.to_string())),
        () = overdue => {
            tracing::warn!(grace_secs = grace.as_secs_f64(), "streams were still open at shutdown");
            Ok(())
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_taken_port_is_named_with_its_cure() {
        let first = bind("127.0.0.1:0").await.unwrap();
        let address = first.local_addr().unwrap();
        let error = bind(&address.to_string()).await.unwrap_err();
        assert!(matches!(error, RpcError::InUse { .. }));
        assert!(error.to_string().contains(&address.to_string()), "{error}");
        assert!(error.to_string().contains("another port"), "{error}");
    }

    #[tokio::test]
    async fn a_server_answers_health_checks_and_ends_in_time_with_a_stream_open() {
        use tonic_health::pb::HealthCheckRequest;
        use tonic_health::pb::health_client::HealthClient;

        let listener = bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let (_reporter, service) = tonic_health::server::health_reporter();
        let shutdown = CancellationToken::new();
        let router = server().add_service(service);
        let running = tokio::spawn(serve_within(
            router,
            TcpIncoming::from(listener),
            shutdown.clone(),
            Duration::from_millis(200),
        ));
        let mut client = HealthClient::new(crate::channel(&address).unwrap());
        // A watch stays open for ever.
        let mut watch = client
            .watch(HealthCheckRequest::default())
            .await
            .unwrap()
            .into_inner();
        assert!(watch.message().await.unwrap().is_some());
        shutdown.cancel();
        tokio::time::timeout(Duration::from_secs(5), running)
            .await
            .unwrap()
            .unwrap()
            .unwrap();
    }
}
