//! Where secrets lie.

use std::path::{Path, PathBuf};

use super::{Role, SecurityError};

/// The files that a process takes its security from. All are optional: without any, nothing is encrypted and
/// nobody is asked who they are.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Files {
    /// Certificates (PEM) of the authorities that servers' certificates come from: turns TLS on for clients.
    pub ca: Option<PathBuf>,
    /// This process's certificate chain (PEM): turns TLS on for servers; clients show it.
    pub cert: Option<PathBuf>,
    /// The certificate's private key (PEM).
    pub key: Option<PathBuf>,
    /// Certificates (PEM) of the authorities that clients' certificates must come from.
    pub client_ca: Option<PathBuf>,
    /// The token that a client shows.
    pub token: Option<PathBuf>,
    /// The tokens that a server takes ([`Tokens`](super::Tokens)).
    pub tokens: Option<PathBuf>,
}

impl Files {
    /// What `isodream secrets` puts into `folder`, for a client in `role`.
    pub fn of_client(folder: &Path, role: Role) -> Self {
        Self {
            ca: Some(folder.join("ca.pem")),
            cert: Some(folder.join("client.pem")),
            key: Some(folder.join("client.key")),
            token: Some(folder.join(format!("{role}.token"))),
            ..Self::default()
        }
    }

    /// What `isodream secrets` puts into `folder`, for a server.
    pub fn of_server(folder: &Path) -> Self {
        Self {
            cert: Some(folder.join("server.pem")),
            key: Some(folder.join("server.key")),
            client_ca: Some(folder.join("ca.pem")),
            tokens: Some(folder.join("tokens")),
            ..Self::default()
        }
    }

    /// These files, and those of `others` where these name none.
    #[must_use]
    pub fn or(self, others: Self) -> Self {
        Self {
            ca: self.ca.or(others.ca),
            cert: self.cert.or(others.cert),
            key: self.key.or(others.key),
            client_ca: self.client_ca.or(others.client_ca),
            token: self.token.or(others.token),
            tokens: self.tokens.or(others.tokens),
        }
    }

    /// Certificate and key, which come together or not at all.
    pub(super) fn identity(&self) -> Result<Option<tonic::transport::Identity>, SecurityError> {
        let incomplete = |given, missing| SecurityError::Incomplete { given, missing };
        match (&self.cert, &self.key) {
            (Some(cert), Some(key)) => {
                let identity = tonic::transport::Identity::from_pem(
                    pem(cert, "CERTIFICATE")?,
                    pem(key, "PRIVATE KEY")?,
                );
                Ok(Some(identity))
            }
            (None, None) => Ok(None),
            (Some(_), None) => Err(incomplete("--tls-cert", "--tls-key")),
            (None, Some(_)) => Err(incomplete("--tls-key", "--tls-cert")),
        }
    }
}

pub(super) fn text(path: &Path) -> Result<String, SecurityError> {
    std::fs::read_to_string(path).map_err(|error| SecurityError::Unreadable {
        path: path.to_owned(),
        reason: error.to_string(),
    })
}

/// A file that holds at least one PEM block of this kind.
pub(super) fn pem(path: &Path, kind: &str) -> Result<String, SecurityError> {
    let text = text(path)?;
    let begins = |line: &str| line.starts_with("-----BEGIN ") && line.contains(kind);
    if !text.lines().any(begins) {
        return Err(SecurityError::Invalid {
            path: path.to_owned(),
            reason: format!("it holds no PEM block of a {}", kind.to_lowercase()),
        });
    }
    Ok(text)
}
