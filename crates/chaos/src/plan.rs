//! What a training consists of, and how each role of it is started.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use rand::RngExt;

use crate::netns::Network;
use crate::role::RoleSpec;
use crate::settings::Settings;

/// Append streams of a ledger actor.
const LANES: usize = 2;

/// What to start.
#[derive(Debug)]
pub(crate) struct Plan {
    pub(crate) settings: Settings,
    pub(crate) replays: usize,
    pub(crate) actors: usize,
    pub(crate) ledgers: usize,
    /// Hosts of their own for all roles, or loopback.
    pub(crate) network: Option<Network>,
    /// Folder of the store of `replay-0`, where it is not to lie with the others.
    pub(crate) first_store: Option<PathBuf>,
    /// Folder made by `isodream secrets`: mutual TLS and tokens; without one, everything is open.
    pub(crate) secrets: Option<PathBuf>,
    /// Variables of single roles, by name.
    pub(crate) env: BTreeMap<String, Vec<(String, String)>>,
}

impl Plan {
    /// Two replay-servers, two actors, an evaluator and two ledger actors with two lanes each.
    pub(crate) fn usual(more: &[&str]) -> Self {
        Self {
            settings: Settings::for_faults(2, more),
            replays: 2,
            actors: 2,
            ledgers: 2,
            network: None,
            first_store: None,
            secrets: None,
            env: BTreeMap::new(),
        }
    }

    /// All roles, servers first.
    fn names(&self) -> Vec<String> {
        let of = |kind: &'static str, count| (0..count).map(move |n| format!("{kind}-{n}"));
        let servers = of("replay", self.replays).chain(["learner".to_owned()]);
        let actors = of("actor", self.actors).chain(["evaluator".to_owned()]);
        let all = servers.chain(actors).chain(of("ledger", self.ledgers));
        all.collect()
    }

    /// How many append streams may write to one server.
    pub(crate) fn streams(&self) -> usize {
        self.actors + LANES * self.ledgers
    }
}

/// Where everything of a training is.
#[derive(Debug)]
pub(crate) struct Layout {
    folder: PathBuf,
    /// Addresses of the replay-servers.
    pub(crate) replays: Vec<String>,
    /// Address of the learner.
    pub(crate) learner: String,
    pub(crate) stores: Vec<PathBuf>,
    pub(crate) ledgers: Vec<PathBuf>,
}

impl Layout {
    /// Files go into `folder`.
    pub(crate) fn new(plan: &Plan, folder: &Path) -> Result<Self> {
        let address = |name: &str| match &plan.network {
            Some(network) => Ok(format!("{}:7000", network.address(name)?)),
            None => free_address(),
        };
        let mut stores: Vec<PathBuf> = (0..plan.replays)
            .map(|n| folder.join(format!("replay-{n}")))
            .collect();
        if let (Some(given), Some(first)) = (&plan.first_store, stores.first_mut()) {
            first.clone_from(given);
        }
        Ok(Self {
            folder: folder.to_owned(),
            replays: (0..plan.replays)
                .map(|n| address(&format!("replay-{n}")))
                .collect::<Result<_>>()?,
            learner: address("learner")?,
            stores,
            ledgers: (0..plan.ledgers)
                .map(|n| folder.join(format!("ledger-{n}.txt")))
                .collect(),
        })
    }

    /// The run's directory.
    pub(crate) fn run_dir(&self) -> PathBuf {
        self.folder.join("run")
    }

    /// How each role is started, with the `isodream` at `binary`.
    pub(crate) fn specs(&self, plan: &Plan, binary: &Path) -> Result<Vec<RoleSpec>> {
        let names = plan.names();
        let specs = names.into_iter().map(|name| {
            let mut command = match &plan.network {
                Some(network) => network.inside(&name)?,
                None => Vec::new(),
            };
            command.extend(self.command(&name, binary)?);
            command.extend(plan.settings.args());
            let mut env = plan.env.get(&name).cloned().unwrap_or_default();
            let secrets = plan.secrets.as_deref();
            env.extend(secrets.map(|folder| ("ISODREAM_SECRETS".into(), text(folder))));
            Ok(RoleSpec {
                command,
                env,
                log: self.folder.join(format!("{name}.log")),
                name,
            })
        });
        specs.collect()
    }

    fn command(&self, name: &str, binary: &Path) -> Result<Vec<String>> {
        let binary = text(binary);
        let servers = self.replays.join(",");
        let run_dir = text(&self.run_dir());
        let lanes = LANES.to_string();
        let number = |kind: &str| name.strip_prefix(kind)?.parse::<usize>().ok();
        if let Some(n) = number("ledger-") {
            let this = text(&std::env::current_exe().context("this program has no path")?);
            let ledger = text(&self.ledgers[n]);
            let words = [&this, "ledger-actor", "--id", name, "--lanes", &lanes];
            let more = ["--ledger", &ledger, "--replay", &servers];
            return Ok(owned(&[&words[..], &more].concat()));
        }
        let words = if let Some(n) = number("replay-") {
            let (store, listen) = (text(&self.stores[n]), &self.replays[n]);
            owned(&[&binary, "replay", "--dir", &store, "--listen", listen])
        } else if name == "learner" {
            let words = [&binary, "learner", "--run-dir", &run_dir];
            let more = ["--listen", &self.learner, "--replay", &servers];
            owned(&[&words[..], &more].concat())
        } else {
            let kind = if name == "evaluator" {
                "evaluate"
            } else {
                "collect"
            };
            let words = [&binary, "actor", "--role", kind, "--id", name];
            let more = ["--learner", &self.learner, "--replay", &servers];
            owned(&[&words[..], &more].concat())
        };
        Ok([words, owned(&["--supervised"])].concat())
    }
}

fn owned(words: &[&str]) -> Vec<String> {
    words.iter().map(|&word| word.to_owned()).collect()
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

/// A loopback address below the ports that the system gives to clients, so that nobody takes it while its server is
/// being started again.
pub(crate) fn free_address() -> Result<String> {
    for _ in 0..100 {
        let address = format!("127.0.0.1:{}", rand::rng().random_range(20_000..30_000));
        if std::net::TcpListener::bind(&address).is_ok() {
            return Ok(address);
        }
    }
    bail!("no port between 20000 and 30000 is free");
}
