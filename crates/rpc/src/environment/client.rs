//! An environment in another process, as an `Environment`.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use isodream_core::EnvSpec;
use isodream_envs::{
    EnvError, Environment, PrivilegedView, RemoteFault, Transition, check_transition,
};
use isodream_proto::v1::environment_command::Kind as Command;
use isodream_proto::v1::{EnvironmentReset, EnvironmentRow, EnvironmentStep};

use super::convert;
use super::link::Link;
use crate::{Dialer, reconnect_delays};

/// How to drive environments in another process.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RemoteOptions {
    /// How long connecting, a reset or a step may take.
    pub deadline: Duration,
    /// Whether to ask for the classes of pixels, which cost a third of the image's bytes again.
    pub segmentation: bool,
}

impl Default for RemoteOptions {
    /// Half a minute, for simulators that load a map at their reset; no segmentation.
    fn default() -> Self {
        Self {
            deadline: Duration::from_secs(30),
            segmentation: false,
        }
    }
}

/// One environment of another process. Every row that comes from there is checked: shapes, rewards, flags.
///
/// After a failure it has to be reset. If the connection is lost, a reset connects again, trying until
/// the deadline; if the process then offers something else, it is refused.
pub struct RemoteEnvironment {
    peer: Arc<Peer>,
    index: u32,
    /// The connection on which the episode began, and its steps so far; `None` unless one runs.
    episode: Option<(Arc<Link>, u64)>,
    is_over: bool,
    segmentation: Option<Vec<u8>>,
    metrics: Vec<(&'static str, f64)>,
}

/// What the environments of one process share.
struct Peer {
    dialer: Dialer,
    address: String,
    options: RemoteOptions,
    spec: EnvSpec,
    environments: u32,
    link: Mutex<Arc<Link>>,
}

impl RemoteEnvironment {
    /// An environment of the process at `address` (`host:port`). No other client may drive it.
    ///
    /// # Errors
    /// [`EnvError::Remote`], as [`connect_many`](Self::connect_many).
    pub fn connect(
        dialer: &Dialer,
        address: &str,
        options: RemoteOptions,
    ) -> Result<Self, EnvError> {
        Ok(Self::new(
            Arc::new(Peer::connect(dialer, address, 1, options)?),
            0,
        ))
    }

    /// `count` environments of the process at `address` (`host:port`), over one connection. They may be stepped
    /// from different threads, for example in an `isodream_envs::VectorEnvironment`: commands overlap.
    ///
    /// # Errors
    /// [`EnvError::Remote`] if nobody answers in time, if the versions of the protocol differ, if fewer are free
    /// ([`RemoteFault::Lost`]: they may be later), or if what is offered makes no sense.
    pub fn connect_many(
        dialer: &Dialer,
        address: &str,
        count: u32,
        options: RemoteOptions,
    ) -> Result<Vec<Self>, EnvError> {
        let peer = Arc::new(Peer::connect(dialer, address, count, options)?);
        Ok((0..count)
            .map(|index| Self::new(peer.clone(), index))
            .collect())
    }

    /// What the process at `address` (`host:port`) offers, without driving it.
    ///
    /// # Errors
    /// As [`connect_many`](Self::connect_many).
    pub fn offered(
        dialer: &Dialer,
        address: &str,
        options: RemoteOptions,
    ) -> Result<EnvSpec, EnvError> {
        Ok(Peer::connect(dialer, address, 0, options)?.spec)
    }

    fn new(peer: Arc<Peer>, index: u32) -> Self {
        Self {
            peer,
            index,
            episode: None,
            is_over: false,
            segmentation: None,
            metrics: Vec::new(),
        }
    }

    /// Checks and takes in what answered the command that made step `step`.
    fn receive(
        &mut self,
        link: Arc<Link>,
        step: u64,
        message: &EnvironmentRow,
    ) -> Result<Transition, EnvError> {
        let row = convert::row(message);
        check_transition(&self.peer.spec, step, &row)?;
        let pixels = self.peer.spec.image.height * self.peer.spec.image.width;
        let classes = &message.segmentation;
        if !classes.is_empty() && classes.len() != pixels {
            let reason = format!("{} classes came for {pixels} pixels", classes.len());
            return Err(self.peer.fault(RemoteFault::Protocol(reason)));
        }
        self.segmentation = (!classes.is_empty()).then(|| classes.to_vec());
        self.metrics = convert::metrics(message);
        self.is_over = row.is_last;
        self.episode = Some((link, step));
        Ok(row)
    }
}

impl Environment for RemoteEnvironment {
    fn spec(&self) -> &EnvSpec {
        &self.peer.spec
    }

    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        self.episode = None;
        let link = self.peer.link()?;
        let reset = Command::Reset(EnvironmentReset { seed });
        let row = link.command(self.index, reset);
        let row = row.map_err(|fault| self.peer.fault(fault))?;
        self.receive(link, 0, &row)
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        let (expected, actual) = (self.peer.spec.action_dim, action.len());
        if actual != expected {
            return Err(EnvError::ActionDim { expected, actual });
        }
        if let Some(index) = action.iter().position(|value| !value.is_finite()) {
            let value = action[index];
            return Err(EnvError::ActionNotFinite { index, value });
        }
        if self.is_over {
            return Err(EnvError::EpisodeOver);
        }
        let (link, step) = self.episode.take().ok_or(EnvError::NotReset)?;
        let action = action.iter().map(|value| value.clamp(-1.0, 1.0)).collect();
        let row = link.command(self.index, Command::Step(EnvironmentStep { action }));
        let row = row.map_err(|fault| self.peer.fault(fault))?;
        self.receive(link, step + 1, &row)
    }

    fn segmentation(&self) -> Option<Vec<u8>> {
        self.segmentation.clone()
    }

    fn metrics(&self) -> Vec<(&'static str, f64)> {
        self.metrics.clone()
    }

    fn privileged(&self) -> Option<PrivilegedView> {
        None
    }
}

impl Peer {
    fn connect(
        dialer: &Dialer,
        address: &str,
        environments: u32,
        options: RemoteOptions,
    ) -> Result<Self, EnvError> {
        let link = Link::open(dialer, address, environments, options);
        let link = link.map_err(|fault| remote(address, fault))?;
        Ok(Self {
            dialer: dialer.clone(),
            address: address.to_owned(),
            options,
            spec: link.spec.clone(),
            environments,
            link: Mutex::new(Arc::new(link)),
        })
    }

    /// The connection, made anew if it was lost.
    fn link(&self) -> Result<Arc<Link>, EnvError> {
        let mut link = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        if !link.is_open() {
            // Ours may be what keeps a new stream out, if its deadline passed.
            link.close();
            let opened = self.reopen().map_err(|fault| self.fault(fault))?;
            if opened.spec != self.spec {
                let reason = format!("it now offers {}, it was {}", opened.spec, self.spec);
                return Err(self.fault(RemoteFault::Refused(reason)));
            }
            *link = Arc::new(opened);
        }
        Ok(link.clone())
    }

    /// Tries until the deadline: a process that is being started again takes a while to answer.
    fn reopen(&self) -> Result<Link, RemoteFault> {
        let deadline = self.options.deadline;
        let started = Instant::now();
        let mut delays = reconnect_delays();
        loop {
            let options = RemoteOptions {
                deadline: deadline.saturating_sub(started.elapsed()),
                ..self.options
            };
            let opened = Link::open(&self.dialer, &self.address, self.environments, options);
            let fault = match opened {
                Err(fault @ RemoteFault::Lost(_)) => fault,
                other => return other,
            };
            let delay = delays.next().unwrap_or_default();
            if started.elapsed() + delay >= deadline {
                return Err(fault);
            }
            std::thread::sleep(delay);
        }
    }

    fn fault(&self, fault: RemoteFault) -> EnvError {
        remote(&self.address, fault)
    }
}

fn remote(address: &str, fault: RemoteFault) -> EnvError {
    EnvError::Remote {
        address: address.to_owned(),
        fault,
    }
}
