//! Connections on their way in: paced, each with a ticket that the guard counts, and closed if they never take it, so that
//! a stranger hears why.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt, ReadBuf};
use tokio::runtime::Handle;
use tokio::time::{Sleep, sleep, timeout};
use tokio_stream::{Stream, StreamExt};
use tonic::transport::server::{Connected, TcpConnectInfo};

use super::guard::Ticket;
use crate::Connection;
use crate::limits::{HANDSHAKES_PER_SECOND, LINGER, STRANGER_LIFETIME};

/// `incoming` at most [`HANDSHAKES_PER_SECOND`] times per second: what comes faster waits in the kernel's queue,
/// so that a crowd that returns at once cannot keep a server busy with handshakes alone.
pub(crate) fn admit<C: Connection>(
    incoming: impl Stream<Item = io::Result<C>>,
) -> impl Stream<Item = io::Result<Admitted<C>>> {
    let pause = std::time::Duration::from_secs(1) / HANDSHAKES_PER_SECOND;
    incoming
        .map(|accepted| accepted.map(Admitted::new))
        .throttle(pause)
}

/// A stream of bytes, both ways.
pub(crate) trait Socket: AsyncRead + AsyncWrite + Unpin + Send + 'static {}

impl<S: AsyncRead + AsyncWrite + Unpin + Send + 'static> Socket for S {}

/// A connection with its ticket.
pub(crate) struct Admitted<C: Socket> {
    /// Taken when this is dropped.
    connection: Option<C>,
    ticket: Arc<Ticket>,
    /// When a stranger has to go; none once it is known.
    stranger_until: Option<Pin<Box<Sleep>>>,
}

impl<C: Socket> Admitted<C> {
    fn new(connection: C) -> Self {
        Self {
            connection: Some(connection),
            ticket: Arc::default(),
            stranger_until: Some(Box::pin(sleep(STRANGER_LIFETIME))),
        }
    }

    fn connection(&mut self) -> io::Result<Pin<&mut C>> {
        let connection = self.connection.as_mut().map(Pin::new);
        connection.ok_or_else(|| io::ErrorKind::NotConnected.into())
    }

    /// Whether nothing was let in for too long; else the task is woken when it would be.
    fn is_overdue(&mut self, context: &mut Context<'_>) -> bool {
        if self.ticket.is_taken() {
            self.stranger_until = None;
        }
        let until = self.stranger_until.as_mut();
        until.is_some_and(|until| until.as_mut().poll(context).is_ready())
    }
}

impl<C: Socket> Drop for Admitted<C> {
    /// Reads on for a moment what a stranger still sends, or it would not hear why it is refused, a TLS alert for
    /// example.
    fn drop(&mut self) {
        if self.ticket.is_taken() {
            return;
        }
        if let (Some(mut connection), Ok(runtime)) = (self.connection.take(), Handle::try_current())
        {
            runtime.spawn(timeout(LINGER, async move {
                connection.shutdown().await?;
                tokio::io::copy(&mut connection, &mut tokio::io::sink()).await
            }));
        }
    }
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
        let info = self.connection.as_ref().map(Connected::connect_info);
        let info = info.unwrap_or(TcpConnectInfo {
            local_addr: None,
            remote_addr: None,
        });
        Admission {
            remote: info.remote_addr,
            local: info.local_addr,
            ticket: self.ticket.clone(),
        }
    }
}

impl<C: Socket> AsyncRead for Admitted<C> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.is_overdue(context) {
            let words = "no call came on it that this server lets in";
            return Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, words)));
        }
        self.connection()?.poll_read(context, buffer)
    }
}

impl<C: Socket> AsyncWrite for Admitted<C> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.connection()?.poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.connection()?.poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        let connection = self.connection.as_ref();
        connection.is_some_and(AsyncWrite::is_write_vectored)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.connection()?.poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.connection()?.poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};

    use super::*;
    use crate::GuardLayer;

    #[tokio::test]
    async fn a_stranger_hears_the_last_word_while_it_still_speaks() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut stranger = tokio::net::TcpStream::connect(address).await.unwrap();
        let mut admitted = Admitted::new(listener.accept().await.unwrap().0);
        admitted.write_all(b"go away").await.unwrap();
        drop(admitted);
        // To a socket that is closed the second one fails.
        for _ in 0..3 {
            stranger.write_all(b"let me in").await.unwrap();
            sleep(std::time::Duration::from_millis(50)).await;
        }
        let mut heard = String::new();
        stranger.read_to_string(&mut heard).await.unwrap();
        assert_eq!(heard, "go away");
    }

    #[tokio::test(start_paused = true)]
    async fn a_stranger_is_sent_away_and_who_is_known_stays() {
        let (mut _near, far) = duplex(64);
        let begun = tokio::time::Instant::now();
        let error = Admitted::new(far).read_u8().await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        assert_eq!(begun.elapsed().as_secs(), STRANGER_LIFETIME.as_secs());

        let (mut near, far) = duplex(64);
        let mut known: Admitted<DuplexStream> = Admitted::new(far);
        GuardLayer::new(None, 1).let_in(&known.ticket);
        let later = async {
            sleep(10 * STRANGER_LIFETIME).await;
            near.write_u8(7).await
        };
        let (read, written) = tokio::join!(known.read_u8(), later);
        written.unwrap();
        assert_eq!(read.unwrap(), 7);
    }
}
