//! Who may talk to whom: TLS, and bearer tokens with roles.
//!
//! - [`Credentials`]: what a client trusts and shows
//! - [`Door`]: what a server shows and demands; [`Door::default`] lets everybody in, and only on loopback
//! - [`Role`], [`Tokens`]: who may call what
//! - [`Files`]: where all of that lies. Secrets are read from files, never from a command line, and never printed
//!
//! ```text
//! client ── TLS handshake (paced) ──▶ admission ──▶ guard: token → role → may it call this? ──▶ service
//! ```

mod admission;
mod credentials;
mod door;
mod files;
mod guard;
mod tokens;

pub use credentials::{Bearer, Credentials};
pub use door::Door;
pub use files::Files;
pub use tokens::{Role, Tokens};

pub use guard::GuardLayer;

pub(crate) use admission::admit;

/// A secret or certificate that cannot be used.
#[derive(Debug, Clone, thiserror::Error)]
pub enum SecurityError {
    /// A file cannot be read.
    #[error("cannot read {}: {reason}; `isodream secrets DIR` makes such files", .path.display())]
    Unreadable {
        /// The file.
        path: std::path::PathBuf,
        /// The cause.
        reason: String,
    },
    /// A file's content is not what it should be.
    #[error("{}: {reason}", .path.display())]
    Invalid {
        /// The file.
        path: std::path::PathBuf,
        /// What is wrong, without the content.
        reason: String,
    },
    /// Files that belong together were not given together.
    #[error("{given} is given without {missing}")]
    Incomplete {
        /// The option that is there.
        given: &'static str,
        /// The option that has to come with it.
        missing: &'static str,
    },
    /// A server would be reachable from other machines with nothing to guard it.
    #[error(
        "{address} can be reached from other machines, and nothing guards it: give --tokens or --tls-client-ca \
         (`isodream secrets DIR` and --secrets DIR do both), or --insecure on a network that you trust"
    )]
    Unguarded {
        /// Where it would listen.
        address: std::net::SocketAddr,
    },
}
