//! Certificates and tokens as files, good and bad ones.

use std::path::PathBuf;

use isodream_rpc::Files;
use rcgen::{
    BasicConstraints, CertificateParams, CertifiedIssuer, DnType, ExtendedKeyUsagePurpose, IsCa,
    KeyPair, date_time_ymd,
};
use tempfile::TempDir;

pub(crate) const ACTOR: &str = "actor-token-0123456789";
pub(crate) const LEARNER: &str = "learner-token-0123456789";
pub(crate) const VIEWER: &str = "viewer-token-0123456789";

/// A folder with an authority of its own.
pub(crate) struct Authority {
    folder: TempDir,
    issuer: CertifiedIssuer<'static, KeyPair>,
}

impl Authority {
    pub(crate) fn new(name: &str) -> Self {
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let issuer = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
        let authority = Self {
            folder: TempDir::new().unwrap(),
            issuer,
        };
        authority.write("ca.pem", &authority.issuer.pem());
        authority
    }

    pub(crate) fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    pub(crate) fn ca(&self) -> PathBuf {
        self.folder.path().join("ca.pem")
    }

    /// A certificate and key for `localhost`, valid until the end of `year`.
    fn leaf(&self, purpose: ExtendedKeyUsagePurpose, year: i32) -> Files {
        let mut params = CertificateParams::new(["localhost".to_owned()]).unwrap();
        params.extended_key_usages = vec![purpose];
        params.not_before = date_time_ymd(2000, 1, 1);
        params.not_after = date_time_ymd(year, 12, 31);
        let key = KeyPair::generate().unwrap();
        let certificate = params.signed_by(&key, &self.issuer).unwrap();
        Files {
            cert: Some(self.write(&format!("{year}.pem"), &certificate.pem())),
            key: Some(self.write(&format!("{year}.key"), &key.serialize_pem())),
            ..Files::default()
        }
    }

    pub(crate) fn server_until(&self, year: i32) -> Files {
        self.leaf(ExtendedKeyUsagePurpose::ServerAuth, year)
    }

    pub(crate) fn server(&self) -> Files {
        self.server_until(2999)
    }

    pub(crate) fn client_until(&self, year: i32) -> Files {
        Files {
            ca: Some(self.ca()),
            ..self.leaf(ExtendedKeyUsagePurpose::ClientAuth, year)
        }
    }

    /// The tokens of all roles, for a server.
    pub(crate) fn tokens(&self) -> Files {
        let text = format!("actor {ACTOR}\nlearner {LEARNER}\nviewer {VIEWER}\n");
        Files {
            tokens: Some(self.write("tokens", &text)),
            ..Files::default()
        }
    }

    /// One token, for a client.
    pub(crate) fn token(&self, token: &str) -> Files {
        Files {
            token: Some(self.write("token", token)),
            ..Files::default()
        }
    }
}
