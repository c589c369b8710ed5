//! What a server shows and demands.

use std::fmt;
use std::net::SocketAddr;

use tonic::transport::{Certificate, ServerTlsConfig};

use super::files::{Files, pem};
use super::{GuardLayer, SecurityError, Tokens};
use crate::limits::{CONNECT_TIMEOUT, MAX_CONNECTIONS_PER_TOKEN};

/// What a server shows and demands.
///
/// The default demands nothing, and for that reason opens on loopback addresses only.
#[derive(Clone)]
pub struct Door {
    tls: Option<ServerTlsConfig>,
    demands_certificate: bool,
    tokens: Option<Tokens>,
    max_connections: usize,
    open_to_all: bool,
}

impl Default for Door {
    fn default() -> Self {
        Self {
            tls: None,
            demands_certificate: false,
            tokens: None,
            max_connections: MAX_CONNECTIONS_PER_TOKEN,
            open_to_all: false,
        }
    }
}

impl Door {
    /// Reads the certificates, key and tokens that `files` names for a server.
    ///
    /// # Errors
    /// [`SecurityError`] where a file cannot be used, or belongs to another that is missing.
    pub fn load(files: &Files) -> Result<Self, SecurityError> {
        let identity = files.identity()?;
        if files.client_ca.is_some() && identity.is_none() {
            return Err(SecurityError::Incomplete {
                given: "--tls-client-ca",
                missing: "--tls-cert",
            });
        }
        let tls = match identity {
            Some(identity) => {
                let tls = ServerTlsConfig::new()
                    .identity(identity)
                    .timeout(CONNECT_TIMEOUT);
                Some(match &files.client_ca {
                    Some(path) => {
                        tls.client_ca_root(Certificate::from_pem(pem(path, "CERTIFICATE")?))
                    }
                    None => tls,
                })
            }
            None => None,
        };
        Ok(Self {
            tls,
            demands_certificate: files.client_ca.is_some(),
            tokens: files.tokens.as_deref().map(Tokens::load).transpose()?,
            ..Self::default()
        })
    }

    /// Lets everybody in from everywhere, if nothing else is demanded.
    #[must_use]
    pub fn insecure(self) -> Self {
        Self {
            open_to_all: true,
            ..self
        }
    }

    /// Takes so many connections at once from the bearers of one token, or from all where there are no tokens.
    #[must_use]
    pub fn with_max_connections(self, max_connections: usize) -> Self {
        Self {
            max_connections,
            ..self
        }
    }

    /// Whether a server behind this door may listen there: anywhere if it asks who comes, else on loopback.
    ///
    /// # Errors
    /// [`SecurityError::Unguarded`].
    pub fn check(&self, address: SocketAddr) -> Result<(), SecurityError> {
        let guarded = self.tokens.is_some() || self.demands_certificate;
        if address.ip().to_canonical().is_loopback() || guarded || self.open_to_all {
            return Ok(());
        }
        Err(SecurityError::Unguarded { address })
    }

    pub(crate) fn tls(&self) -> Option<&ServerTlsConfig> {
        self.tls.as_ref()
    }

    pub(crate) fn guard(&self) -> GuardLayer {
        GuardLayer::new(self.tokens.clone(), self.max_connections)
    }
}

impl fmt::Debug for Door {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Door")
            .field("tls", &self.tls.is_some())
            .field("demands_certificate", &self.demands_certificate)
            .field("tokens", &self.tokens.is_some())
            .field("max_connections", &self.max_connections)
            .field("open_to_all", &self.open_to_all)
            .finish()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn an_unguarded_door_opens_on_loopback_only() {
        for (address, allowed) in [
            ("127.0.0.1:1", true),
            ("127.8.0.1:1", true),
            ("[::1]:1", true),
            ("[::ffff:127.0.0.1]:1", true),
            ("0.0.0.0:1", false),
            ("[::]:1", false),
            ("10.0.0.1:1", false),
        ] {
            let address = address.parse().unwrap();
            assert_eq!(Door::default().check(address).is_ok(), allowed, "{address}");
            assert!(Door::default().insecure().check(address).is_ok());
        }
        let error = Door::default().check("10.0.0.1:7001".parse().unwrap());
        let words = error.unwrap_err().to_string();
        assert!(
            words.contains("10.0.0.1:7001") && words.contains("--tokens"),
            "{words}"
        );
    }

    #[test]
    fn certificates_of_clients_need_one_of_the_server() {
        let files = Files {
            client_ca: Some("ca.pem".into()),
            ..Files::default()
        };
        let error = Door::load(&files).unwrap_err().to_string();
        assert_eq!(error, "--tls-client-ca is given without --tls-cert");
    }
}
