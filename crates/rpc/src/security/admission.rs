//! Connections on their way in: paced, and each with a ticket that the guard counts.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_stream::{Stream, StreamExt};
use tonic::transport::server::{Connected, TcpConnectInfo};

use super::guard::Ticket;
use crate::Connection;
use crate::limits::HANDSHAKES_PER_SECOND;

/// `incoming` at most [`HANDSHAKES_PER_SECOND`] times per second: what comes faster waits in the kernel's queue,
/// so that a crowd that returns at once cannot keep a server busy with handshakes alone.
pub(crate) fn admit<C: Connection>(
    incoming: impl Stream<Item = io::Result<C>>,
) -> impl Stream<Item = io::Result<Admitted<C>>> {
    let pause = std::time::Duration::from_secs(1) / HANDSHAKES_PER_SECOND;
    incoming
        .map(|accepted| {
            accepted.map(|connection| Admitted {
                connection,
                ticket: Arc::default(),
            })
        })
        .throttle(pause)
}

/// A connection with its ticket.
pub(crate) struct Admitted<C> {
    connection: C,
    ticket: Arc<Ticket>,
}

/// What a service can ask of the connection that a request came by.
#[derive(Debug, Clone)]
pub(crate) struct Admission {
    pub(super) remote: Option<SocketAddr>,
    pub(super) local: Option<SocketAddr>,
    /// Given back when the connection and everything that came by it is gone.
    pub(super) ticket: Arc<Ticket>,
}

impl Admission {
    pub(super) fn tcp(&self) -> TcpConnectInfo {
        TcpConnectInfo {
            local_addr: self.local,
            remote_addr: self.remote,
        }
    }
}

impl<C: Connection> Connected for Admitted<C> {
    type ConnectInfo = Admission;

    fn connect_info(&self) -> Admission {
        let info = self.connection.connect_info();
        Admission {
            remote: info.remote_addr,
            local: info.local_addr,
            ticket: self.ticket.clone(),
        }
    }
}

impl<C: Connection> AsyncRead for Admitted<C> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.connection).poll_read(context, buffer)
    }
}

impl<C: Connection> AsyncWrite for Admitted<C> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.connection).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.connection).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.connection.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.connection).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.connection).poll_shutdown(context)
    }
}
