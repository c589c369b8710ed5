//! One composition: its containers, and their removal however the test ends.

use std::fs;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

use crate::docker::{docker, quiet};
use crate::stage::answers;

/// The composition under a name of its own, with files that were made for it.
#[derive(Debug)]
pub(super) struct Project {
    /// What Docker calls it.
    pub(super) name: String,
    /// Holds what was made for it; goes with it.
    pub(super) folder: PathBuf,
    file: PathBuf,
    engine: &'static [&'static str],
    environment: Vec<(&'static str, String)>,
    remover: Option<Child>,
}

/// A container as Docker describes it.
#[derive(Debug)]
pub(super) struct Container(Value);

impl Container {
    /// The process that Docker started, as this machine numbers it; 0 while there is none.
    pub(super) fn pid(&self) -> i64 {
        self.0["State"]["Pid"].as_i64().unwrap_or(0)
    }

    pub(super) fn is_running(&self) -> bool {
        self.0["State"]["Status"] == "running"
    }

    pub(super) fn exit_code(&self) -> Option<i64> {
        self.0["State"]["ExitCode"].as_i64()
    }

    /// How often Docker started it by itself.
    pub(super) fn restarts(&self) -> i64 {
        self.0["RestartCount"].as_i64().unwrap_or(0)
    }

    pub(super) fn host_name(&self) -> Option<&str> {
        self.0["Config"]["Hostname"].as_str()
    }

    /// What it was made of.
    pub(super) fn image(&self) -> Option<&str> {
        self.0["Config"]["Image"].as_str()
    }

    /// Its address in the composition's network, while it runs.
    pub(super) fn address(&self) -> Option<&str> {
        let networks = self.0["NetworkSettings"]["Networks"].as_object()?;
        let address = networks.values().next()?["IPAddress"].as_str()?;
        (!address.is_empty()).then_some(address)
    }
}

impl Project {
    /// Makes nothing yet; `environment` is for the variables of the compose file.
    pub(super) fn new(
        name: String,
        file: PathBuf,
        folder: PathBuf,
        environment: Vec<(&'static str, String)>,
    ) -> Result<Self> {
        let mut project = Self {
            name,
            folder,
            file,
            engine: engine()?,
            environment,
            remover: None,
        };
        project.remover = Some(project.start_remover()?);
        Ok(project)
    }

    /// The engine with `args`, to be run or changed.
    pub(super) fn compose(&self, args: &[&str]) -> Command {
        let mut command = Command::new(self.engine[0]);
        command
            .args(&self.engine[1..])
            .args(["--project-name", &self.name, "--file"])
            .arg(&self.file)
            .args(args)
            .envs(self.environment.iter().map(|(name, value)| (name, value)));
        command
    }

    /// Starts what does not run, and as many collecting actors as told.
    pub(super) fn up(&self, actors: usize) -> Result<()> {
        let scale = format!("actor={actors}");
        quiet(&mut self.compose(&["up", "--detach", "--scale", &scale])).map(drop)
    }

    /// Ids of the containers of `service`, running or not.
    pub(super) fn containers(&self, service: &str) -> Result<Vec<String>> {
        let project = format!("label=com.docker.compose.project={}", self.name);
        let service = format!("label=com.docker.compose.service={service}");
        let args = [
            "ps", "--all", "--quiet", "--filter", &project, "--filter", &service,
        ];
        Ok(docker(&args)?.lines().map(str::to_owned).collect())
    }

    /// The only container of `service`.
    pub(super) fn container(&self, service: &str) -> Result<String> {
        let mut found = self.containers(service)?;
        ensure!(
            found.len() == 1,
            "{service} has {} containers, not one",
            found.len()
        );
        Ok(found.remove(0))
    }

    /// The name of a volume of the compose file as Docker knows it.
    pub(super) fn volume(&self, name: &str) -> String {
        format!("{}_{name}", self.name)
    }

    /// Removes everything, and fails if anything stays.
    pub(super) fn remove(&mut self) -> Result<()> {
        self.end_remover()?;
        let label = format!("label=com.docker.compose.project={}", self.name);
        for (kind, list) in [
            ("containers", &["ps", "--all"][..]),
            ("volumes", &["volume", "ls"][..]),
            ("networks", &["network", "ls"][..]),
        ] {
            let left = docker(&[list, &["--quiet", "--filter", &label]].concat())?;
            ensure!(left.is_empty(), "{kind} stay after `down -v`: {left}");
        }
        ensure!(!self.folder.exists(), "{} stays", self.folder.display());
        Ok(())
    }

    /// A process that waits for the end of this one, however it comes, and then removes everything. It is not in our
    /// process group: Ctrl-C does not reach it.
    fn start_remover(&self) -> Result<Child> {
        let down = self.compose(&[
            "--profile",
            "monitoring",
            "down",
            "--volumes",
            "--timeout",
            "1",
        ]);
        let mut shell = Command::new("sh");
        shell
            .args(["-c", "cat; rm -rf \"$0\"; exec \"$@\""])
            .arg(&self.folder)
            .arg(down.get_program())
            .args(down.get_args())
            .envs(self.environment.iter().map(|(name, value)| (name, value)))
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .process_group(0);
        shell.spawn().context("cannot start sh")
    }

    fn end_remover(&mut self) -> Result<()> {
        let Some(mut remover) = self.remover.take() else {
            return Ok(());
        };
        drop(remover.stdin.take());
        let status = remover.wait()?;
        ensure!(status.success(), "`down --volumes` ended with {status}");
        Ok(())
    }
}

impl Drop for Project {
    fn drop(&mut self) {
        if let Err(error) = self.end_remover() {
            eprintln!("xtask: {} was not removed: {error:#}", self.name);
        }
    }
}

/// What Docker says of a container.
pub(super) fn inspect(id: &str) -> Result<Container> {
    let mut found: Vec<Value> = serde_json::from_str(&docker(&["inspect", id])?)?;
    ensure!(found.len() == 1, "docker knows no container {id}");
    Ok(Container(found.remove(0)))
}

/// Makes `path` and everything in it belong to the user of the containers.
pub(super) fn give_to_containers(path: &Path) -> Result<()> {
    const USER: u32 = 10_001;
    std::os::unix::fs::chown(path, Some(USER), Some(USER))
        .with_context(|| format!("cannot give {} to user {USER}", path.display()))?;
    if path.is_dir() {
        for entry in fs::read_dir(path)? {
            give_to_containers(&entry?.path())?;
        }
    }
    Ok(())
}

fn engine() -> Result<&'static [&'static str]> {
    const ENGINES: [&[&str]; 2] = [&["docker", "compose"], &["docker-compose"]];
    for engine in ENGINES {
        if answers(Command::new(engine[0]).args(&engine[1..]).arg("version")) {
            return Ok(engine);
        }
    }
    bail!(
        "neither `docker compose` nor `docker-compose` is there: install one (Debian: apt-get install docker-compose; \
         Ubuntu: apt-get install docker-compose-v2)"
    )
}
