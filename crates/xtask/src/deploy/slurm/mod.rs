//! `cargo xtask deploy slurm`: `deploy/slurm/isodream.sbatch` run for real, on a Slurm of this machine's own.
//!
//! Two nodes train the debug preset, a third takes over from one that fails. What is durable is looked at twice a
//! second, and may never get less.

mod cluster;
mod run;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use clap::Args;

use self::cluster::{Cluster, NODES, address, node_name};
use self::run::{Progress, Run, command_lines, until, until_job};
use crate::run::release_binary;
use crate::stage::{self, output, stage, with_native};

/// How long a job may take to stop.
const DRAIN: Duration = Duration::from_secs(25);

/// Options of `cargo xtask deploy slurm`.
#[derive(Debug, Args)]
pub(crate) struct SlurmArgs {
    /// The binary to run; the release binary is built by default
    #[arg(long)]
    binary: Option<PathBuf>,
    /// Environment frames of the run: more on a faster machine, where it must outlast everything that is done to it
    #[arg(long, default_value_t = 60_000)]
    env_frames: u64,
    /// Neither tokens nor TLS
    #[arg(long)]
    insecure: bool,
    /// Leave the folder with all logs
    #[arg(long)]
    keep: bool,
}

/// Runs the batch script through everything that it must survive, and prints what was done.
pub(crate) fn slurm(root: &Path, args: &SlurmArgs) -> Result<()> {
    cluster::require()?;
    let script = root.join("deploy/slurm/isodream.sbatch");
    stage("shellcheck", || {
        stage::run(Command::new("shellcheck").arg(&script))
    })?;
    let binary = match &args.binary {
        Some(binary) => fs::canonicalize(binary)
            .with_context(|| format!("no binary at {}", binary.display()))?,
        None => release_binary(root)?,
    };
    let dir = std::env::temp_dir().join(format!("isodream-slurm-{}", std::process::id()));
    fs::create_dir(&dir).with_context(|| format!("cannot make {}", dir.display()))?;
    let mut drill = Drill {
        cluster: Cluster::start(&dir)?,
        script,
        dir: dir.clone(),
        insecure: args.insecure,
        rows: Vec::new(),
    };
    let result = drill.all(root, &binary, args.env_frames);
    drill.print();
    drop(drill);
    if args.keep {
        eprintln!("xtask: everything is in {}", dir.display());
        return result;
    }
    let job_logs = fs::read_dir(&dir)?.flatten().map(|entry| entry.path());
    for log in job_logs.filter(|path| result.is_err() && path.extension() == Some("out".as_ref())) {
        eprintln!("{}:\n{}", log.display(), fs::read_to_string(&log)?);
    }
    fs::remove_dir_all(&dir).with_context(|| format!("cannot remove {}", dir.display()))?;
    result
}

/// The cluster, and what was done with it.
struct Drill {
    cluster: Cluster,
    script: PathBuf,
    dir: PathBuf,
    insecure: bool,
    rows: Vec<(String, f64, String)>,
}

impl Drill {
    fn all(&mut self, root: &Path, binary: &Path, env_frames: u64) -> Result<()> {
        self.step("nodes wait for jobs", |drill| {
            until("all nodes are idle", || {
                Ok((drill.cluster.idle_nodes() == NODES).then_some(()))
            })?;
            Ok(format!("{NODES}"))
        })?;

        let settings = [
            "--preset".to_owned(),
            "debug".into(),
            "--set=learner.prefill_steps=60".into(),
            format!("--set=learner.env_frames={env_frames}"),
        ];
        let run_dir = self.dir.join("run");
        let job = self.submit("run", &run_dir, &["--nodes=2"], &settings, (root, binary))?;
        let mut run = Run::new(binary, root, run_dir.clone(), job);
        self.step("submitted; first checkpoint", |drill| {
            let progress = run.goes_on(&drill.cluster)?;
            ensure!(
                progress.inserted.len() == 2,
                "{} stores, not one per replay-server",
                progress.inserted.len()
            );
            placed_on(&run, [0, 1])?;
            Ok(told(&progress))
        })?;
        if !self.insecure {
            self.step("secrets are the owner's, on no command line", |_| {
                secrets_are_kept(&run)
            })?;
        }
        let actor = format!("actor-{}-0", run.job);
        let store = run_dir.join("replay/0").to_string_lossy().into_owned();
        for (role, words) in [
            ("actor", ["actor", &actor]),
            ("replay-server", ["replay", &store]),
            ("learner", ["learner", &run_dir.to_string_lossy()]),
        ] {
            self.step(&format!("kill -9 of the {role}; it came back"), |_| {
                run.kill(&words)?;
                Ok(String::new())
            })?;
            self.step("  the run went on", |drill| {
                Ok(told(&run.goes_on(&drill.cluster)?))
            })?;
        }

        self.step("node1 failed; the job runs again", |drill| {
            drill.cluster.fail_node(1)?;
            drill.restarted(&run, 1)?;
            Ok("on node0 and node2".into())
        })?;
        self.step("  the run went on", |drill| {
            let progress = run.goes_on(&drill.cluster)?;
            placed_on(&run, [0, 2])?;
            Ok(told(&progress))
        })?;

        self.cluster.start_node(1)?;
        let joined = self.submit("join", &run_dir, &["--nodes=1"], &settings, (root, binary))?;
        let guest = format!("actor-{joined}-0");
        let mut stored = 0;
        self.step("node1 is back; its actors joined the run", |drill| {
            until_job(&drill.cluster, &joined, &["RUNNING"])?;
            stored = stores_from(&mut run, &guest, 0)?;
            Ok(format!("{stored} chunks of {guest} stored"))
        })?;

        self.step("scontrol requeue; all roles stopped", |drill| {
            drill.cluster.control(["requeue", &run.job])?;
            drill.drained(&run)
        })?;
        self.step("  the job runs again, and the run went on", |drill| {
            drill.restarted(&run, 2)?;
            Ok(told(&run.goes_on(&drill.cluster)?))
        })?;
        self.step("  the joined actors found it again", |_| {
            let now = stores_from(&mut run, &guest, stored)?;
            Ok(format!("{now} chunks of {guest} stored"))
        })?;

        self.step("time limit near; the job requeued itself", |drill| {
            let job = format!("JobId={}", run.job);
            // Slurm counts in minutes, and warns a minute before.
            drill.cluster.control(["update", &job, "TimeLimit=2"])?;
            until("the job is requeued", || {
                let job = drill.cluster.job(&run.job)?;
                Ok((job.field("Restarts") == "3" || job.state() == "PENDING").then_some(()))
            })?;
            drill
                .cluster
                .control(["update", &job, "TimeLimit=UNLIMITED"])?;
            Ok(String::new())
        })?;
        self.step("  the job runs again, and the run went on", |drill| {
            drill.restarted(&run, 3)?;
            Ok(told(&run.goes_on(&drill.cluster)?))
        })?;

        self.step("the last update; the job is COMPLETED", |drill| {
            until_job(&drill.cluster, &run.job, &["COMPLETED"])?;
            Ok(told(&run.progress()?))
        })?;
        self.step("  the job that joined is COMPLETED too", |drill| {
            until_job(&drill.cluster, &joined, &["COMPLETED"])?;
            Ok(String::new())
        })?;
        self.step("all checksums of all stores", |_| {
            for shard in run.shards() {
                output(run.ask(["replay", "verify"]).arg(shard))?;
            }
            Ok("no damage".into())
        })
    }

    /// Does one thing and notes how long it took.
    fn step(&mut self, name: &str, work: impl FnOnce(&mut Self) -> Result<String>) -> Result<()> {
        let start = Instant::now();
        let seen = stage(name.trim(), || work(self))?;
        self.rows
            .push((name.to_owned(), start.elapsed().as_secs_f64(), seen));
        Ok(())
    }

    fn submit(
        &self,
        mode: &str,
        run_dir: &Path,
        options: &[&str],
        settings: &[String],
        (root, binary): (&Path, &Path),
    ) -> Result<String> {
        let mut sbatch = self.cluster.command("sbatch");
        with_native(&mut sbatch, root);
        sbatch
            .args(["--parsable", "--output"])
            .arg(self.dir.join("%j.out"))
            .args(options)
            .arg(&self.script)
            .args([Path::new(mode), run_dir])
            .args(settings)
            .env("ISODREAM", binary)
            .env("ISODREAM_SHARDS", "2")
            .env("ISODREAM_ACTORS_PER_NODE", "2")
            .env("ISODREAM_INSECURE", self.insecure.to_string())
            // All nodes are this one machine, and share its few cores.
            .env("OMP_NUM_THREADS", "1");
        let id = String::from_utf8(output(&mut sbatch)?)?;
        Ok(id.trim().to_owned())
    }

    /// Waits for the start after so many restarts.
    fn restarted(&self, run: &Run<'_>, restarts: u32) -> Result<()> {
        until(&format!("job {} runs again", run.job), || {
            let job = self.cluster.job(&run.job)?;
            let again = job.field("Restarts") == restarts.to_string();
            Ok((again && job.state() == "RUNNING").then_some(()))
        })
    }

    /// Waits until no role of the job runs.
    fn drained(&self, run: &Run<'_>) -> Result<String> {
        let start = Instant::now();
        let folder = run.dir.to_string_lossy().into_owned();
        let own = format!("actor-{}", run.job);
        until("all roles have stopped", || {
            let binary = run.binary.to_string_lossy();
            let running = command_lines().any(|(_, line)| {
                line.starts_with(binary.as_ref()) && (line.contains(&folder) || line.contains(&own))
            });
            Ok((!running).then_some(()))
        })?;
        ensure!(
            start.elapsed() < DRAIN,
            "the roles took {:.0} s to stop, more than {} s",
            start.elapsed().as_secs_f64(),
            DRAIN.as_secs()
        );
        Ok(String::new())
    }

    fn print(&self) {
        eprintln!("{:<48} {:>7}  seen", "done", "seconds");
        for (name, seconds, seen) in &self.rows {
            eprintln!("{name:<48} {seconds:>7.1}  {seen}");
        }
    }
}

/// What a row of the table says of the run.
fn told(progress: &Progress) -> String {
    format!(
        "checkpoint {}, {:?} steps stored",
        progress.updates, progress.inserted
    )
}

/// Fails unless the addresses are those of `nodes`: a replay-server on each, the learner on the first.
fn placed_on(run: &Run<'_>, nodes: [usize; 2]) -> Result<()> {
    let found = run.addresses()?.join(" ");
    let [first, second] = nodes.map(address);
    let hosts: Vec<&str> = found
        .split([' ', ','])
        .take(3)
        .filter_map(|address| address.split(':').next())
        .collect();
    ensure!(
        hosts == [first.as_str(), second.as_str(), first.as_str()],
        "the roles are at {found}, not on {}",
        nodes.map(node_name).join(" and ")
    );
    Ok(())
}

/// Waits until more than `before` chunks of an actor are stored.
fn stores_from(run: &mut Run<'_>, actor: &str, before: u64) -> Result<u64> {
    until(&format!("steps of {actor} are stored"), || {
        let stored = run.progress()?.actors.get(actor).copied();
        Ok(stored.filter(|stored| *stored > before))
    })
}

/// Fails where others than the owner may read the secrets, or a token is an argument of any process.
fn secrets_are_kept(run: &Run<'_>) -> Result<String> {
    let addresses = run.addresses()?;
    let folder = addresses
        .get(2)
        .context("addresses name no folder of secrets")?;
    let parent = run.dir.join("secrets");
    let mode = fs::metadata(&parent)?.permissions().mode() & 0o777;
    ensure!(mode == 0o700, "{} has mode {mode:o}", parent.display());
    let path = Path::new(folder).join("actor.token");
    let token = fs::read_to_string(&path).with_context(|| format!("no {}", path.display()))?;
    let token = token.trim();
    ensure!(!token.is_empty(), "{} is empty", path.display());
    ensure!(
        !command_lines().any(|(_, line)| line.contains(token)),
        "the actors' token is on a command line"
    );
    Ok(format!("{mode:o}"))
}
