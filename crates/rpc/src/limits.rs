//! The numbers behind every connection.

use std::time::Duration;

/// Largest message in bytes, both ways: a 50 x 64 x 64 x 3 sequence is 614 KB raw; gRPC's default is 4 MB.
pub const MAX_MESSAGE_BYTES: usize = 64 << 20;
/// HTTP/2 frame size in bytes: on loopback twice the throughput of the default 16 KB.
pub const MAX_FRAME_BYTES: u32 = 1 << 20;
/// HTTP/2 window of one stream in bytes.
pub const STREAM_WINDOW_BYTES: u32 = 8 << 20;
/// HTTP/2 window of one connection in bytes.
pub const CONNECTION_WINDOW_BYTES: u32 = 32 << 20;
/// How long connecting may take, and then the TLS handshake.
pub const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Connections that a server accepts per second; what comes faster waits in the kernel's queue.
pub const HANDSHAKES_PER_SECOND: u32 = 500;
/// Open connections of the bearers of one token at most, unless a server is told otherwise.
pub const MAX_CONNECTIONS_PER_TOKEN: usize = 20_000;
/// How long a connection may stay open without a call that the server lets in. Health checks are let in by everybody and
/// do not count.
pub const STRANGER_LIFETIME: Duration = Duration::from_secs(30);
/// Calls that one connection may have open: clients here need a handful.
pub const MAX_STREAMS_PER_CONNECTION: u32 = 256;
/// Pause between HTTP/2 keepalive pings.
pub const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(10);
/// How long a ping may stay unanswered before the connection counts as dead.
pub const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a peer may take for its first message.
pub const HELLO_TIMEOUT: Duration = Duration::from_secs(10);
/// How long what a peer still sends is read after the last word to it: a connection that is closed with unread bytes is
/// reset, and that word would be lost with it.
pub const LINGER: Duration = Duration::from_secs(1);
/// How long open streams may take to end at shutdown.
pub const SHUTDOWN_GRACE: Duration = Duration::from_secs(3);
/// How long an actor's replay-server may stay away before the actor turns to the next one.
pub const FAILOVER_AFTER: Duration = Duration::from_secs(15);
/// First and longest pause of an actor between two rounds in which it looks for a store that it left: each asks all
/// servers, and thousands of actors may have left the same one.
pub const LEFTOVERS_DELAYS: (Duration, Duration) =
    (Duration::from_secs(2), Duration::from_secs(15));
/// The longest such pause of an actor that ends.
pub const LAST_LEFTOVERS_DELAY: Duration = Duration::from_secs(1);
/// How often a learner asks its replay-servers what they hold.
pub const STATUS_INTERVAL: Duration = Duration::from_secs(1);
/// How long such an answer may take, and one that tells an actor which store is there.
pub const STATUS_TIMEOUT: Duration = Duration::from_secs(5);
/// How often a learner looks up again which replay-servers its names stand for.
pub const RESOLVE_INTERVAL: Duration = Duration::from_secs(10);
/// First and longest pause between attempts to reconnect.
pub const RECONNECT_DELAYS: (Duration, Duration) =
    (Duration::from_millis(100), Duration::from_secs(5));
