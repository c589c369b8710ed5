//! The servers of the load generator, in processes of their own: replay-servers, which are the role itself, and the
//! learner's door.

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use isodream_proto::Identity;
use isodream_proto::v1::{PolicyVersion, ReplayStatusRequest};
use isodream_rpc::{Dialer, ReplayClient};

use super::LoadArgs;
use super::board::Board;
use super::commits::Commits;
use super::door::{DoorWork, EPOCH};
use super::process::Usage;
use crate::bench::replay::part::Part;
use crate::config_args::ConfigArgs;

/// How long a server may take to be up.
const START_DEADLINE: Duration = Duration::from_secs(30);

/// A running replay-server; it is told to stop when this is dropped.
struct ReplayProcess {
    child: Child,
    address: String,
    metrics: String,
}

impl ReplayProcess {
    /// Starts a server with a folder of its own in `dir`. With `relay`, it hands on the policies of that learner.
    fn start(dir: &Path, config: &ConfigArgs, relay: Option<&str>) -> anyhow::Result<Self> {
        let [address, metrics] = [free_address()?, free_address()?];
        let mut command = Command::new(std::env::current_exe()?);
        command
            .args(["replay", "--supervised", "--listen", &address])
            .args(["--metrics-listen", &metrics, "--dir"])
            .arg(dir)
            .args(config.args())
            .env(isodream_telemetry::LOG_FILTER_VARIABLE, "warn")
            .stdin(Stdio::piped())
            .stdout(Stdio::null());
        if let Some(learner) = relay {
            command.args(["--relay-policy", learner]);
        }
        let child = command.spawn().context("cannot start a replay-server")?;
        Ok(Self {
            child,
            address,
            metrics,
        })
    }

    fn id(&self) -> u32 {
        self.child.id()
    }

    /// Waits until it answers.
    async fn up(&mut self, client: ReplayClient) -> anyhow::Result<()> {
        let begun = Instant::now();
        while begun.elapsed() < START_DEADLINE {
            if let Some(status) = self.child.try_wait()? {
                bail!("the replay-server at {} ended with {status}", self.address);
            }
            if client.clone().status(ReplayStatusRequest {}).await.is_ok() {
                return Ok(());
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        bail!(
            "the replay-server at {} did not answer within {START_DEADLINE:?}",
            self.address
        )
    }
}

/// Free now; if something takes it meanwhile, the server says so and ends.
fn free_address() -> std::io::Result<String> {
    Ok(TcpListener::bind("127.0.0.1:0")?.local_addr()?.to_string())
}

impl Drop for ReplayProcess {
    fn drop(&mut self) {
        // It stops when its standard input closes.
        drop(self.child.stdin.take());
        let _ = self.child.wait();
    }
}

/// The processes of the measurement; those that it started end with it.
pub(super) struct Servers {
    replay: Vec<ReplayProcess>,
    door: Option<Part>,
    door_address: String,
    published: u64,
    /// Of the own servers; removed in the end.
    _folder: Option<Folder>,
}

struct Folder(PathBuf);

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

impl Servers {
    pub(super) fn start(args: &LoadArgs, identity: &Identity) -> anyhow::Result<Self> {
        if let Some(learner) = &args.learner {
            return Ok(Self {
                replay: Vec::new(),
                door: None,
                door_address: learner.clone(),
                published: 0,
                _folder: None,
            });
        }
        let mut door = Part::spawn(
            &["load-door"],
            &DoorWork {
                env_spec_hash: identity.env_spec_hash.clone(),
                env_spec: identity.env_spec.clone(),
                model_hash: identity.model_hash.clone(),
                bytes: args.policy_bytes,
            },
        )?;
        let door_address: String = door.hear()?;
        let folder = make_folder(&args.dir)?;
        let mut settings = args.config.clone();
        if args.learners == 0 {
            // The ratio begins to count when there are so many steps.
            let settings = &mut settings.set;
            settings.push("learner.prefill_steps=1_000_000_000_000".to_owned());
            settings.push("learner.env_frames=1_000_000_000_000_000".to_owned());
        }
        let relay = args.relay.then_some(door_address.as_str());
        let replay = (0..args.servers)
            .map(|index| ReplayProcess::start(&folder.0.join(index.to_string()), &settings, relay))
            .collect::<anyhow::Result<_>>()?;
        Ok(Self {
            replay,
            door: Some(door),
            door_address,
            published: 0,
            _folder: Some(folder),
        })
    }

    /// Waits until the own replay-servers answer.
    pub(super) async fn up(&mut self, dialer: &Dialer) -> anyhow::Result<()> {
        for server in &mut self.replay {
            server.up(dialer.replay(&server.address)?).await?;
        }
        Ok(())
    }

    pub(super) fn addresses(&self) -> Vec<String> {
        self.replay
            .iter()
            .map(|server| server.address.clone())
            .collect()
    }

    /// Where actors find policies.
    pub(super) fn learners(&self, args: &LoadArgs, replay: &[String]) -> Vec<String> {
        if args.relay {
            replay.to_vec()
        } else {
            vec![self.door_address.clone()]
        }
    }

    /// Publishes the next version, if the door is an own one.
    pub(super) fn publish(&mut self, board: &Board) -> anyhow::Result<()> {
        let Some(door) = &mut self.door else {
            return Ok(());
        };
        self.published += 1;
        board.published(PolicyVersion {
            learner_epoch: EPOCH,
            version: self.published,
        });
        tokio::task::block_in_place(|| {
            door.ask(&self.published.to_string())?;
            door.hear()
        })
    }

    /// What each own replay-server has made durable.
    pub(super) async fn commits(&self) -> anyhow::Result<Vec<Commits>> {
        let mut all = Vec::new();
        for server in &self.replay {
            all.push(Commits::read(&server.metrics).await?);
        }
        Ok(all)
    }

    /// What each process has used: this one, and its own.
    pub(super) fn usage(&self) -> anyhow::Result<Vec<(String, Usage)>> {
        let mut all = vec![("actors".to_owned(), Usage::of(std::process::id())?)];
        if let Some(door) = &self.door {
            all.push(("door".to_owned(), Usage::of(door.id())?));
        }
        for (index, server) in self.replay.iter().enumerate() {
            all.push((format!("replay-{index}"), Usage::of(server.id())?));
        }
        Ok(all)
    }
}

fn make_folder(dir: &Path) -> anyhow::Result<Folder> {
    ensure!(
        !dir.exists(),
        "{} is left of an earlier run; delete it",
        dir.display()
    );
    std::fs::create_dir_all(dir).with_context(|| format!("cannot make {}", dir.display()))?;
    Ok(Folder(dir.to_owned()))
}
