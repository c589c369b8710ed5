//! Environments as a configuration names them, in this process or in another.

use std::time::{Duration, Instant};

use isodream_core::EnvSpec;
use isodream_core::config::EnvConfig;
use isodream_envs::{EnvError, Environment, RemoteFault, conform, conformed_spec};

use super::{RemoteEnvironment, RemoteOptions};
use crate::{Dialer, reconnect_delays};

/// How long a process that does not answer yet, or is driven by others, is waited for.
pub const ENVIRONMENT_PATIENCE: Duration = Duration::from_secs(30);

/// The address in an id `grpc://host:port`; none in the id of an environment of this process.
pub fn remote_address(id: &str) -> Option<&str> {
    id.strip_prefix("grpc://")
}

/// One environment as `config` describes it, which of another process also tells the classes of pixels if it can.
///
/// # Errors
/// As [`open_environments`].
pub fn open_environment(
    dialer: &Dialer,
    config: &EnvConfig,
) -> Result<Box<dyn Environment>, EnvError> {
    let options = RemoteOptions {
        segmentation: true,
        ..RemoteOptions::default()
    };
    let opened = open(dialer, config, 1, options)?.pop();
    opened.ok_or(EnvError::EmptyVector)
}

/// `count` environments as `config` describes them. An id `grpc://host:port` names those of another process,
/// over one connection, which are then made to [`conform`]; for up to half a minute they are waited for.
///
/// # Errors
/// [`EnvError`] of `isodream_envs::make`, of [`RemoteEnvironment::connect_many`] and of [`conform`].
pub fn open_environments(
    dialer: &Dialer,
    config: &EnvConfig,
    count: usize,
) -> Result<Vec<Box<dyn Environment>>, EnvError> {
    open(dialer, config, count, RemoteOptions::default())
}

fn open(
    dialer: &Dialer,
    config: &EnvConfig,
    count: usize,
    options: RemoteOptions,
) -> Result<Vec<Box<dyn Environment>>, EnvError> {
    let Some(address) = remote_address(&config.id) else {
        return (0..count).map(|_| isodream_envs::make(config)).collect();
    };
    let remote = patiently(ENVIRONMENT_PATIENCE, || {
        RemoteEnvironment::connect_many(dialer, address, count as u32, options)
    })?;
    remote
        .into_iter()
        .map(|env| conform(Box::new(env), config))
        .collect()
}

/// The spec of [`open_environments`], without making or driving any; another process is waited for at most for
/// `patience`.
///
/// # Errors
/// As [`open_environments`].
pub fn environment_spec(
    dialer: &Dialer,
    config: &EnvConfig,
    patience: Duration,
) -> Result<EnvSpec, EnvError> {
    let Some(address) = remote_address(&config.id) else {
        return isodream_envs::spec(config);
    };
    let offered = patiently(patience, || {
        RemoteEnvironment::offered(dialer, address, RemoteOptions::default())
    })?;
    conformed_spec(&offered, config)
}

/// Tries for as long as `patience` lasts to reach a process that is not there, or is busy.
fn patiently<T>(
    patience: Duration,
    connect: impl Fn() -> Result<T, EnvError>,
) -> Result<T, EnvError> {
    let begun = Instant::now();
    let mut delays = reconnect_delays();
    loop {
        let connected = connect();
        let delay = delays.next().unwrap_or_default();
        match connected {
            Err(error) if is_passing(&error) && begun.elapsed() + delay < patience => {
                tracing::warn!(%error, "trying again");
                std::thread::sleep(delay);
            }
            other => return other,
        }
    }
}

fn is_passing(error: &EnvError) -> bool {
    matches!(
        error,
        EnvError::Remote {
            fault: RemoteFault::Lost(_),
            ..
        }
    )
}
