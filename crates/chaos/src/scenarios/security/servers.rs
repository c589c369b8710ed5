//! A replay-server, a learner and an environment server behind the same door.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use isodream_proto::PROTOCOL_VERSION;
use isodream_rpc::{Dialer, Files};
use tonic::Status;

use crate::interrupt;
use crate::plan::free_address;
use crate::probe::Probe;
use crate::role::{Role, RoleSpec};
use crate::scenarios::calls::{self, Addresses, Call};
use crate::settings::Settings;

/// How long the servers may take until they listen.
const UP: Duration = Duration::from_secs(60);

/// The servers. Dropping them kills them.
pub(super) struct Servers {
    addresses: Addresses,
    roles: Vec<Role>,
    probe: Probe,
    store: PathBuf,
}

impl Servers {
    /// Starts them in the folder `home`, with what `door` names, and waits until they listen.
    pub(super) fn start(binary: &Path, home: &Path, door: &Files) -> Result<Self> {
        std::fs::create_dir_all(home)?;
        let addresses = Addresses {
            replay: free_address()?,
            learner: free_address()?,
            environment: free_address()?,
        };
        let settings = Settings::for_faults(1, &[]).args();
        let store = home.join("store");
        let text = |path: &Path| path.display().to_string();
        let (store_text, run_dir) = (text(&store), text(&home.join("run")));
        let replay = [
            "replay",
            "--dir",
            &store_text,
            "--listen",
            &addresses.replay,
        ];
        let learner = [
            "learner",
            "--run-dir",
            &run_dir,
            "--listen",
            &addresses.learner,
        ];
        let learner = [&learner[..], &["--replay", &addresses.replay]].concat();
        let environment = [
            "env",
            "serve",
            "highway/day",
            "--listen",
            &addresses.environment,
        ];
        let mut roles = Vec::new();
        for (name, args, settings) in [
            ("replay", &replay[..], &settings[..]),
            ("learner", &learner, &settings),
            ("environment", &environment, &[]),
        ] {
            let mut command = vec![text(binary)];
            command.extend(args.iter().map(|&word| word.to_owned()));
            command.extend_from_slice(settings);
            roles.push(Role::start(RoleSpec {
                name: name.into(),
                command,
                env: variables(door),
                log: home.join(format!("{name}.log")),
            })?);
        }
        let servers = Self {
            addresses,
            roles,
            probe: Probe::new(None, Dialer::default())?,
            store,
        };
        let all = [
            &servers.addresses.replay,
            &servers.addresses.learner,
            &servers.addresses.environment,
        ];
        for address in all {
            interrupt::until(&format!("{address} listens"), UP, || {
                Ok(std::net::TcpStream::connect(address).ok().map(drop))
            })
            .with_context(|| servers.log().unwrap_or_default())?;
        }
        Ok(servers)
    }

    /// Makes `call` as `dialer` does.
    pub(super) fn call(&self, dialer: Dialer, call: Call) -> Result<Result<(), Status>> {
        self.probe.run(calls::make(
            dialer,
            self.addresses.clone(),
            call,
            PROTOCOL_VERSION,
        ))
    }

    /// What all of them logged.
    pub(super) fn log(&self) -> Result<String> {
        self.roles.iter().map(|role| role.log_since(0)).collect()
    }

    /// Whether the processes are those that were started, and still listen.
    pub(super) fn check_alive(&self) -> Result<()> {
        for role in &self.roles {
            if let Some(status) = role.exits().first() {
                bail!(
                    "{} ended with {status}: {}",
                    role.name(),
                    role.log_since(0)?
                );
            }
        }
        Ok(())
    }

    /// Stops them; returns the folder of the store.
    pub(super) fn stop(self) -> Result<PathBuf> {
        for role in self.roles.iter().rev() {
            role.stop()?;
        }
        Ok(self.store)
    }
}

/// The variables that a server takes `door` from.
fn variables(door: &Files) -> Vec<(String, String)> {
    let named = [
        ("ISODREAM_TLS_CERT", &door.cert),
        ("ISODREAM_TLS_KEY", &door.key),
        ("ISODREAM_TLS_CLIENT_CA", &door.client_ca),
        ("ISODREAM_TOKENS", &door.tokens),
    ];
    let given = named.into_iter().filter_map(|(name, path)| {
        let path = path.as_ref()?.display().to_string();
        Some((name.to_owned(), path))
    });
    given.collect()
}
