//! What a client trusts and shows.

use std::fmt;

use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::transport::{Certificate, ClientTlsConfig};
use tonic::{Request, Status};

use super::files::{Files, pem, text};
use super::{SecurityError, tokens};
use crate::limits::CONNECT_TIMEOUT;

/// What a client trusts and shows: nothing by default, which is plain TCP without a token.
#[derive(Clone, Default)]
pub struct Credentials {
    tls: Option<ClientTlsConfig>,
    bearer: Bearer,
}

impl Credentials {
    /// Reads the certificates, key and token that `files` names for a client.
    ///
    /// # Errors
    /// [`SecurityError`] where a file cannot be used, or belongs to another that is missing.
    pub fn load(files: &Files) -> Result<Self, SecurityError> {
        let tls = match &files.ca {
            Some(ca) => {
                let authorities = Certificate::from_pem(pem(ca, "CERTIFICATE")?);
                let tls = ClientTlsConfig::new()
                    .ca_certificate(authorities)
                    .timeout(CONNECT_TIMEOUT);
                Some(match files.identity()? {
                    Some(identity) => tls.identity(identity),
                    None => tls,
                })
            }
            None => None,
        };
        let bearer = match &files.token {
            Some(path) => {
                let invalid = |reason: String| SecurityError::Invalid {
                    path: path.clone(),
                    reason,
                };
                let text = text(path)?;
                let token = text.trim();
                tokens::check(token).map_err(invalid)?;
                let mut value: MetadataValue<Ascii> = format!("Bearer {token}")
                    .parse()
                    .map_err(|_| invalid("the token is not printable".to_owned()))?;
                value.set_sensitive(true);
                Bearer(Some(value))
            }
            None => Bearer(None),
        };
        Ok(Self { tls, bearer })
    }

    pub(crate) fn tls(&self) -> Option<&ClientTlsConfig> {
        self.tls.as_ref()
    }

    pub(crate) fn bearer(&self) -> Bearer {
        self.bearer.clone()
    }
}

impl fmt::Debug for Credentials {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Credentials")
            .field("tls", &self.tls.is_some())
            .field("token", &self.bearer.0.is_some())
            .finish()
    }
}

/// Adds the token to every call, where there is one.
#[derive(Clone, Default)]
pub struct Bearer(Option<MetadataValue<Ascii>>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(value) = &self.0 {
            request
                .metadata_mut()
                .insert("authorization", value.clone());
        }
        Ok(request)
    }
}

impl fmt::Debug for Bearer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Bearer").field(&self.0.is_some()).finish()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn secrets_never_show_in_debug_output() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("actor.token");
        std::fs::write(&path, "0123456789abcdef-very-secret\n").unwrap();
        let files = Files {
            token: Some(path),
            ..Files::default()
        };
        let mut credentials = Credentials::load(&files).unwrap();
        assert!(!format!("{credentials:?} {:?}", credentials.bearer()).contains("secret"));
        let request = credentials.bearer.call(Request::new(())).unwrap();
        let value = request.metadata().get("authorization").unwrap();
        assert_eq!(value, "Bearer 0123456789abcdef-very-secret");
        assert!(!format!("{request:?}").contains("very-secret"));
    }

    #[test]
    fn what_is_wrong_with_a_file_is_said_without_its_content() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        std::fs::write(&path, "short").unwrap();
        let load = |files: Files| Credentials::load(&files).unwrap_err().to_string();
        let token = load(Files {
            token: Some(path.clone()),
            ..Files::default()
        });
        assert!(
            token.contains("16 characters") && !token.contains("short"),
            "{token}"
        );
        let ca = load(Files {
            ca: Some(path),
            ..Files::default()
        });
        assert!(ca.contains("no PEM block of a certificate"), "{ca}");
        let missing = load(Files {
            ca: Some(folder.path().join("nowhere")),
            ..Files::default()
        });
        assert!(
            missing.contains("nowhere") && missing.contains("isodream secrets"),
            "{missing}"
        );
    }
}
