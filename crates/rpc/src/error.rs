//! Errors, and their one mapping to and from gRPC status.

use std::net::SocketAddr;
use std::time::Duration;

use isodream_proto::{InvalidMessage, Mismatch};
use tonic::{Code, Status};

/// A failure of this side of a connection.
#[derive(Debug, Clone, thiserror::Error)]
pub enum RpcError {
    /// The address is not one.
    #[error("`{address}` is not an address: {reason}; write host:port")]
    Address {
        /// What was given.
        address: String,
        /// What is wrong with it.
        reason: String,
    },
    /// Another process listens there.
    #[error("{address} is in use by another process; stop that process or choose another port")]
    InUse {
        /// The address.
        address: SocketAddr,
    },
    /// Listening failed for another reason.
    #[error("cannot listen on {address}: {reason}")]
    Listen {
        /// The address.
        address: String,
        /// The cause.
        reason: String,
    },
    /// Certificates or tokens cannot be used.
    #[error(transparent)]
    Security(#[from] crate::SecurityError),
    /// Certificate, key and authority do not make a TLS configuration.
    #[error("TLS cannot be set up: {0}; look at --tls-ca, --tls-cert and --tls-key")]
    Tls(String),
    /// A server does not serve.
    #[error("{address} does not serve: {reason}")]
    Unhealthy {
        /// The server's address.
        address: String,
        /// Why.
        reason: String,
    },
    /// The server ended with an error.
    #[error("server failed: {0}")]
    Serve(String),
    /// No handler for a signal could be installed.
    #[error("cannot listen for signals: {0}")]
    Signal(String),
    /// The peer refused us for good: trying again cannot help.
    #[error("{peer} refused: {reason}")]
    Refused {
        /// The peer's address.
        peer: String,
        /// Its words.
        reason: String,
    },
    /// The client was closed or its task is gone.
    #[error("the connection to {peer} is closed")]
    Closed {
        /// The peer's address.
        peer: String,
    },
    /// Too many replay-servers went away with chunks that they had not acknowledged.
    #[error(
        "{chunks} chunks were given up: replay-servers went away before they acknowledged them"
    )]
    GivenUp {
        /// How many.
        chunks: usize,
    },
    /// Chunks were still unacknowledged at the deadline.
    #[error("{chunks} chunks were not acknowledged by {peer} within {deadline:?}{}", .why.as_ref().map(|why| format!(": {why}")).unwrap_or_default())]
    NotFlushed {
        /// The peer's address.
        peer: String,
        /// How many.
        chunks: usize,
        /// The deadline.
        deadline: Duration,
        /// What the client was waiting for.
        why: Option<String>,
    },
}

impl RpcError {
    pub(crate) fn tls(error: &tonic::transport::Error) -> Self {
        Self::Tls(with_causes(error.to_string(), error))
    }
}

/// What a service answers instead of a reply.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ServiceError {
    /// The peer does not belong here: other environment, older epoch. Trying again cannot help.
    #[error("{0}")]
    Refused(String),
    /// The message makes no sense. Trying again cannot help.
    #[error("{0}")]
    Invalid(String),
    /// What was asked for does not exist (any more).
    #[error("{0}")]
    NotFound(String),
    /// A resource is used up, for example the disk. Trying again later can help.
    #[error("{0}")]
    Exhausted(String),
    /// The stream lost its order and has to start over.
    #[error("{0}")]
    OutOfOrder(String),
    /// The server stops or is not ready. Trying again can help.
    #[error("{0}")]
    Unavailable(String),
    /// A defect or a failed disk.
    #[error("{0}")]
    Internal(String),
}

impl From<ServiceError> for Status {
    fn from(error: ServiceError) -> Self {
        let code = match error {
            ServiceError::Refused(_) => Code::FailedPrecondition,
            ServiceError::Invalid(_) => Code::InvalidArgument,
            ServiceError::NotFound(_) => Code::NotFound,
            ServiceError::Exhausted(_) => Code::ResourceExhausted,
            ServiceError::OutOfOrder(_) => Code::Aborted,
            ServiceError::Unavailable(_) => Code::Unavailable,
            ServiceError::Internal(_) => Code::Internal,
        };
        Self::new(code, error.to_string())
    }
}

impl From<Mismatch> for ServiceError {
    fn from(mismatch: Mismatch) -> Self {
        Self::Refused(mismatch.to_string())
    }
}

impl From<InvalidMessage> for ServiceError {
    fn from(invalid: InvalidMessage) -> Self {
        Self::Invalid(invalid.to_string())
    }
}

/// Whether a peer's answer stays the same however often it is asked: [`ServiceError::Refused`],
/// [`ServiceError::Invalid`], a message beyond the cap, or a service the peer does not have.
pub fn is_refusal(status: &Status) -> bool {
    matches!(
        status.code(),
        Code::FailedPrecondition
            | Code::InvalidArgument
            | Code::OutOfRange
            | Code::Unimplemented
            | Code::PermissionDenied
            | Code::Unauthenticated
    )
}

/// A status as a person reads it: its words, or its code where it has none.
pub(crate) fn words(status: &Status) -> String {
    if status.message().is_empty() {
        return status.code().description().to_lowercase();
    }
    // hyper's own words ("transport error") hide the cause, which is what a person can act on.
    let mut words = with_causes(status.message().to_owned(), status);
    if let Some((_, cure)) = CURES.iter().find(|(sign, _)| words.contains(sign)) {
        words = format!("{words}; {cure}");
    }
    words
}

/// What two sides that do not agree on TLS see of it, and what helps.
const CURES: [(&str, &str); 7] = [
    (
        "frame with invalid size",
        "it seems to speak TLS: give --tls-ca, or --secrets",
    ),
    (
        "corrupt message of type InvalidContentType",
        "it does not speak TLS: start it with certificates, or leave --tls-ca and --secrets out",
    ),
    (
        "UnknownIssuer",
        "its certificate comes from another authority than --tls-ca",
    ),
    (
        "NotValidForName",
        "its certificate is made out to other names: `isodream secrets DIR --host NAME` names this one",
    ),
    (
        "invalid peer certificate: certificate expired",
        "make new certificates, and look at the clocks of both machines",
    ),
    (
        "CertificateRequired",
        "it asks for a certificate: give --tls-cert and --tls-key, or --secrets",
    ),
    (
        "received fatal alert",
        "it does not accept this process's certificate (--tls-cert)",
    ),
];

fn with_causes(mut words: String, error: &dyn std::error::Error) -> String {
    let mut source = error.source();
    while let Some(cause) = source {
        let cause_words = cause.to_string();
        if !words.contains(&cause_words) {
            words = format!("{words}: {cause_words}");
        }
        source = cause.source();
    }
    words
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_cannot_change_is_a_refusal() {
        let of = |error: ServiceError| Status::from(error);
        let words = || "words".to_owned();
        for final_answer in [
            ServiceError::Refused(words()),
            ServiceError::Invalid(words()),
        ] {
            assert!(is_refusal(&of(final_answer)));
        }
        for passing in [
            ServiceError::NotFound(words()),
            ServiceError::Exhausted(words()),
            ServiceError::OutOfOrder(words()),
            ServiceError::Unavailable(words()),
            ServiceError::Internal(words()),
        ] {
            let status = of(passing);
            assert!(!is_refusal(&status), "{status}");
            assert_eq!(super::words(&status), "words");
        }
    }
}
