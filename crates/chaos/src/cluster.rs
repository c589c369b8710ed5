//! A whole training as processes: replay-servers, a learner, actors, an evaluator and ledger actors.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use isodream_core::{Chunk, Config};
use isodream_rpc::Role::Viewer;
use tempfile::TempDir;

use crate::interrupt;
use crate::ledger::{self, Audit, Stored};
use crate::netns::Network;
use crate::plan::{Layout, Plan};
use crate::probe::Probe;
use crate::role::Role;
use crate::secrets;
use crate::watch::{Inserts, Watch, Watched};

/// How long a training may take until its first updates.
const BEGIN: Duration = Duration::from_secs(120);

/// A moment, as the ends of all logs.
#[derive(Debug)]
pub(crate) struct Mark(BTreeMap<String, u64>);

/// A training that runs. Dropping it ends all of it and removes what it wrote.
#[derive(Debug)]
pub(crate) struct Cluster {
    // Dropped in this order.
    pub(crate) watch: Watch,
    roles: BTreeMap<String, Role>,
    pub(crate) network: Option<Network>,
    pub(crate) probe: Probe,
    pub(crate) config: Config,
    pub(crate) layout: Layout,
    folder: TempDir,
    begun: Instant,
}

impl Cluster {
    /// Starts everything and waits until updates and inserts move.
    pub(crate) fn start(binary: &Path, plan: Plan) -> Result<Self> {
        let config = plan.settings.load()?;
        let folder = tempfile::tempdir()?;
        let dialer = secrets::dialer(plan.secrets.as_deref(), Viewer)?;
        let hub = plan.network.as_ref().map(Network::hub);
        let probe = Probe::new(hub.as_deref(), dialer.clone())?;
        let layout = Layout::new(&plan, folder.path())?;
        // From its own host: what a broken link hides would count as standing still.
        let watched = |name: &str, address: &str| -> Result<Watched> {
            let probe = match &plan.network {
                Some(network) => Probe::new(Some(&network.host(name)?), dialer.clone())?,
                None => probe.clone(),
            };
            let address = address.to_owned();
            Ok(Watched { probe, address })
        };
        let learner = watched("learner", &layout.learner)?;
        let replays = layout.replays.iter().enumerate();
        let replays = replays.map(|(index, address)| watched(&format!("replay-{index}"), address));
        let replays = replays.collect::<Result<Vec<_>>>()?;
        let mut roles = BTreeMap::new();
        for spec in layout.specs(&plan, binary)? {
            roles.insert(spec.name.clone(), Role::start(spec)?);
        }
        let watch = Watch::start(learner, replays, config.clone(), plan.streams())?;
        let begun = Instant::now();
        let cluster = Self {
            watch,
            roles,
            network: plan.network,
            probe,
            config,
            layout,
            folder,
            begun,
        };
        if let Err(error) = cluster.watch.recovery(begun, Inserts::Any, BEGIN) {
            bail!(
                "the training does not begin: {error:#}\n{}",
                cluster.last_lines()
            );
        }
        Ok(cluster)
    }

    pub(crate) fn role(&self, name: &str) -> Result<&Role> {
        let role = self.roles.get(name);
        role.with_context(|| format!("the cluster has no {name}"))
    }

    pub(crate) fn roles(&self) -> impl Iterator<Item = &Role> {
        self.roles.values()
    }

    /// Folder of the run's checkpoints.
    pub(crate) fn checkpoints(&self) -> PathBuf {
        self.layout.run_dir().join("checkpoints")
    }

    /// Where all logs end now.
    pub(crate) fn mark(&self) -> Mark {
        let ends = self
            .roles()
            .map(|role| (role.name().to_owned(), role.log_end()));
        Mark(ends.collect())
    }

    /// Waits until a role whose name begins with `who` has said `words` since `mark`, and returns the line.
    pub(crate) fn line(
        &self,
        mark: &Mark,
        who: &str,
        words: &str,
        deadline: Duration,
    ) -> Result<String> {
        interrupt::until(&format!("{who} says `{words}`"), deadline, || {
            self.said(mark, who, words)
        })
    }

    /// The line in which a role whose name begins with `who` has said `words` since `mark`.
    pub(crate) fn said(&self, mark: &Mark, who: &str, words: &str) -> Result<Option<String>> {
        for role in self.roles().filter(|role| role.name().starts_with(who)) {
            let log = role.log_since(mark.0.get(role.name()).copied().unwrap_or(0))?;
            if let Some(line) = log.lines().find(|line| line.contains(words)) {
                return Ok(Some(format!("{} says: {line}", role.name())));
            }
        }
        Ok(None)
    }

    /// Stops everything and compares stores and ledgers; `check` sees every chunk. Adds what is wrong to `failures`.
    pub(crate) fn finish(
        mut self,
        failures: &mut Vec<String>,
        check: impl FnMut(&Chunk) -> Result<()>,
    ) -> Result<Audit> {
        self.stop(failures)?;
        let audit = self.audit(check).unwrap_or_else(|error| {
            failures.push(format!("the stores cannot be compared: {error:#}"));
            Audit::default()
        });
        if !audit.is_clean() {
            failures.push(format!("stores and ledgers differ: {audit:?}"));
        }
        if !self.layout.ledgers.is_empty() && audit.acknowledged_steps == 0 {
            failures.push("no ledger actor was acknowledged anything".into());
        }
        if !failures.is_empty() {
            let kept = self.folder.path().with_extension("failed");
            self.folder.disable_cleanup(true);
            std::fs::rename(self.folder.path(), &kept)?;
            failures.push(format!("kept in {}", kept.display()));
        }
        Ok(audit)
    }

    /// SIGTERM to all, those that send first.
    fn stop(&self, failures: &mut Vec<String>) -> Result<()> {
        let order = ["ledger-", "actor-", "evaluator", "learner", "replay-"];
        for kind in order {
            for role in self.roles().filter(|role| role.name().starts_with(kind)) {
                match role.stop() {
                    Ok((took, Some(status))) if !status.success() && status.code() != Some(75) => {
                        failures.push(format!(
                            "{} ended with {status} {:.1} s after SIGTERM",
                            role.name(),
                            took.as_secs_f64()
                        ));
                    }
                    Ok(_) => {}
                    Err(error) => failures.push(format!("{error:#}")),
                }
            }
        }
        // What SIGTERM could not end must not write while the stores are read.
        for role in self.roles() {
            if role.pid().is_some() {
                role.kill()?;
            }
        }
        Ok(())
    }

    fn audit(&self, mut check: impl FnMut(&Chunk) -> Result<()>) -> Result<Audit> {
        let mut acknowledged = Vec::new();
        for path in &self.layout.ledgers {
            acknowledged.extend(ledger::read(path)?);
        }
        let mut stored = Stored::default();
        for store in &self.layout.stores {
            stored.read(store, &mut check)?;
        }
        Ok(Audit::of(&acknowledged, &stored))
    }

    /// When the training began.
    pub(crate) fn begun(&self) -> Instant {
        self.begun
    }

    /// The last line of each role's log, for errors.
    fn last_lines(&self) -> String {
        let lines = self.roles().map(|role| {
            let log = role.log_since(0).unwrap_or_default();
            let last = log
                .lines()
                .last()
                .unwrap_or("nothing was logged")
                .to_owned();
            format!("{}: {}", role.name(), role.trouble().unwrap_or(last))
        });
        lines.collect::<Vec<_>>().join("\n")
    }
}
