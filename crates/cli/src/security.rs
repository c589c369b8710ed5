//! The options that decide who may talk to whom.
//!
//! Secrets come from files whose names may be given by environment variables: nothing secret is ever an argument.

use std::path::PathBuf;

use clap::Args;
use isodream_rpc::{Credentials, Dialer, Door, Files, Role, RpcError, SecurityError};

/// What a process trusts and shows.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Security")]
pub(crate) struct ClientArgs {
    /// A folder made by `isodream secrets`: certificates on both sides, and tokens
    #[arg(long, value_name = "DIR", env = "ISODREAM_SECRETS")]
    pub(crate) secrets: Option<PathBuf>,
    /// File with the token that servers ask for
    #[arg(long, value_name = "FILE", env = "ISODREAM_TOKEN_FILE")]
    token_file: Option<PathBuf>,
    /// Certificate authority of the servers (PEM): speak TLS to them
    #[arg(long, value_name = "FILE", env = "ISODREAM_TLS_CA")]
    tls_ca: Option<PathBuf>,
    /// This process's own certificate chain (PEM)
    #[arg(long, value_name = "FILE", env = "ISODREAM_TLS_CERT")]
    tls_cert: Option<PathBuf>,
    /// The certificate's private key (PEM)
    #[arg(long, value_name = "FILE", env = "ISODREAM_TLS_KEY")]
    tls_key: Option<PathBuf>,
}

impl ClientArgs {
    /// How servers are reached by a process in this role.
    pub(crate) fn dialer(&self, role: Role) -> Result<Dialer, SecurityError> {
        Ok(Dialer::new(Credentials::load(&self.files_of(role))?))
    }

    /// How servers are reached for what needs no token.
    pub(crate) fn dialer_without_token(&self) -> Result<Dialer, SecurityError> {
        let files = Files {
            token: None,
            ..self.files_of(Role::Viewer)
        };
        Ok(Dialer::new(Credentials::load(&files)?))
    }

    fn files_of(&self, role: Role) -> Files {
        let folder = self.secrets.as_deref();
        let others = folder.map_or_else(Files::default, |folder| Files::of_client(folder, role));
        self.files().or(others)
    }

    fn files(&self) -> Files {
        Files {
            ca: self.tls_ca.clone(),
            cert: self.tls_cert.clone(),
            key: self.tls_key.clone(),
            token: self.token_file.clone(),
            ..Files::default()
        }
    }
}

/// What a server shows and demands, and what it shows where it is a client itself.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Security")]
pub(crate) struct DoorArgs {
    #[command(flatten)]
    pub(crate) client: ClientArgs,
    /// Clients must show a certificate of this authority (PEM)
    #[arg(long, value_name = "FILE", env = "ISODREAM_TLS_CLIENT_CA")]
    tls_client_ca: Option<PathBuf>,
    /// The tokens that are taken: lines `ROLE TOKEN`, where a role is actor, learner or viewer
    #[arg(long, value_name = "FILE", env = "ISODREAM_TOKENS")]
    tokens: Option<PathBuf>,
    /// Listen where other machines can reach it though nothing guards it
    #[arg(long, env = "ISODREAM_INSECURE")]
    insecure: bool,
    /// Open connections of the bearers of one token at most
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    max_connections: Option<u32>,
}

impl DoorArgs {
    /// What `train` hands on to the roles that it starts.
    #[cfg(feature = "torch")]
    pub(crate) fn of_train(secrets: Option<PathBuf>, insecure: bool) -> Self {
        Self {
            client: ClientArgs {
                secrets,
                ..ClientArgs::default()
            },
            insecure,
            ..Self::default()
        }
    }

    /// The server's door.
    pub(crate) fn door(&self) -> Result<Door, RpcError> {
        let folder = self.client.secrets.as_deref();
        let files = Files {
            client_ca: self.tls_client_ca.clone(),
            tokens: self.tokens.clone(),
            ..self.client.files()
        };
        let files = files.or(folder.map_or_else(Files::default, Files::of_server));
        let mut door = Door::load(&files)?;
        if let Some(limit) = self.max_connections {
            door = door.with_max_connections(limit as usize);
        }
        Ok(if self.insecure { door.insecure() } else { door })
    }
}
