//! The skeleton of every server.

use std::net::SocketAddr;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::server::NamedService;
use tonic::transport::Server;
use tonic::transport::server::{Connected, Router, TcpConnectInfo, TcpIncoming};
use tonic_health::pb::health_server::{Health, HealthServer};
use tower_layer::{Identity, Stack};

use crate::limits::{
    CONNECTION_WINDOW_BYTES, KEEPALIVE_INTERVAL, KEEPALIVE_TIMEOUT, MAX_FRAME_BYTES,
    MAX_STREAMS_PER_CONNECTION, SHUTDOWN_GRACE, STREAM_WINDOW_BYTES,
};
use crate::security::admit;
use crate::{Door, GuardLayer, RpcError};

/// A connection that a server can serve.
pub trait Connection:
    AsyncRead + AsyncWrite + Connected<ConnectInfo = TcpConnectInfo> + Unpin + Send + 'static
{
}

impl<C> Connection for C where
    C: AsyncRead + AsyncWrite + Connected<ConnectInfo = TcpConnectInfo> + Unpin + Send + 'static
{
}

/// A server whose calls pass its [`Door`].
pub type GuardedServer = Server<Stack<GuardLayer, Identity>>;

/// Services behind a [`Door`].
pub type GuardedRouter = Router<Stack<GuardLayer, Identity>>;

/// Listens on `address` (`host:port`; port 0 takes a free one) for a server behind `door`.
///
/// # Errors
/// [`RpcError::InUse`] where another process listens, [`RpcError::Security`] where nothing would guard it from
/// other machines, [`RpcError::Listen`] for everything else.
pub async fn bind(address: &str, door: &Door) -> Result<TcpListener, RpcError> {
    let failed = |error: std::io::Error| RpcError::Listen {
        address: address.to_owned(),
        reason: error.to_string(),
    };
    let resolved: Vec<SocketAddr> = tokio::net::lookup_host(address)
        .await
        .map_err(failed)?
        .collect();
    for &address in &resolved {
        door.check(address)?;
    }
    match TcpListener::bind(resolved.as_slice()).await {
        Ok(listener) => Ok(listener),
        Err(error) if error.kind() == std::io::ErrorKind::AddrInUse => match resolved.last() {
            Some(&address) => Err(RpcError::InUse { address }),
            None => Err(failed(error)),
        },
        Err(error) => Err(failed(error)),
    }
}

/// A server builder with this project's limits, behind `door`. Services set their message caps to
/// [`crate::limits::MAX_MESSAGE_BYTES`] themselves.
///
/// # Errors
/// [`RpcError::Tls`] where the door's certificates make no sense.
pub fn server(door: &Door) -> Result<GuardedServer, RpcError> {
    let builder = match door.tls() {
        Some(tls) => Server::builder()
            .tls_config(tls.clone())
            .map_err(|error| RpcError::tls(&error))?,
        None => Server::builder(),
    };
    Ok(builder
        .layer(door.guard())
        .max_concurrent_streams(MAX_STREAMS_PER_CONNECTION)
        .http2_keepalive_interval(Some(KEEPALIVE_INTERVAL))
        .http2_keepalive_timeout(Some(KEEPALIVE_TIMEOUT))
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .max_frame_size(MAX_FRAME_BYTES))
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
    router: GuardedRouter,
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
    router: GuardedRouter,
    incoming: impl Stream<Item = std::io::Result<C>>,
    shutdown: CancellationToken,
) -> Result<(), RpcError> {
    serve_within(router, incoming, shutdown, SHUTDOWN_GRACE).await
}

async fn serve_within<C: Connection>(
    router: GuardedRouter,
    incoming: impl Stream<Item = std::io::Result<C>>,
    shutdown: CancellationToken,
    grace: Duration,
) -> Result<(), RpcError> {
    let incoming = admit(incoming);
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
        let first = bind("127.0.0.1:0", &Door::default()).await.unwrap();
        let address = first.local_addr().unwrap();
        let error = bind(&address.to_string(), &Door::default())
            .await
            .unwrap_err();
        assert!(matches!(error, RpcError::InUse { .. }));
        assert!(error.to_string().contains(&address.to_string()), "{error}");
        assert!(error.to_string().contains("another port"), "{error}");
    }

    #[tokio::test]
    async fn a_server_answers_health_checks_and_ends_in_time_with_a_stream_open() {
        use tonic_health::pb::HealthCheckRequest;
        use tonic_health::pb::health_client::HealthClient;

        let listener = bind("127.0.0.1:0", &Door::default()).await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let (_reporter, service) = tonic_health::server::health_reporter();
        let shutdown = CancellationToken::new();
        let router = server(&Door::default()).unwrap().add_service(service);
        let running = tokio::spawn(serve_within(
            router,
            TcpIncoming::from(listener),
            shutdown.clone(),
            Duration::from_millis(200),
        ));
        let mut client = HealthClient::new(crate::Dialer::default().wire(&address).unwrap());
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
