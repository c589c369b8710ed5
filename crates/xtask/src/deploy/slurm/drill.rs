//! What is done to a run, one thing after the other, and the table of it.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use super::cluster::{Cluster, NODES, URGENT, node_name};
use super::run::{Run, until, until_job};
use crate::stage::{output, stage, with_native};

/// How long roles may take to stop.
const DRAIN: Duration = Duration::from_secs(25);

/// What is tried.
#[derive(Debug)]
pub(super) struct Subject {
    pub(super) root: PathBuf,
    pub(super) binary: PathBuf,
    pub(super) script: PathBuf,
    pub(super) insecure: bool,
    pub(super) env_frames: u64,
}

/// A run in a cluster of its own, and what was done to it.
#[derive(Debug)]
pub(super) struct Drill {
    subject: Subject,
    dir: PathBuf,
    run: Run,
    /// What, in how many seconds, and what was seen.
    rows: Vec<(String, f64, String)>,
    // Last, so that jobs are killed when nobody asks for them any more.
    cluster: Cluster,
}

impl Drill {
    /// Starts a cluster in `dir` and submits a run.
    pub(super) fn new(subject: Subject, dir: &Path) -> Result<Self> {
        let cluster = Cluster::start(dir)?;
        stage("nodes wait for jobs", || {
            until("all nodes are idle", || {
                Ok((cluster.idle_nodes() == NODES).then_some(()))
            })
        })?;
        let mut drill = Self {
            run: Run::new(&subject, dir.join("run")),
            subject,
            dir: dir.to_owned(),
            rows: Vec::new(),
            cluster,
        };
        drill.run.job = drill.submit("run", 2)?;
        Ok(drill)
    }

    /// Does everything.
    ///
    /// # Errors
    /// The first thing that the run did not survive as it must.
    pub(super) fn all(&mut self) -> Result<()> {
        self.begins()?;
        self.roles_are_killed()?;
        self.a_node_fails()?;
        self.a_second_job_is_refused()?;
        let (joined, guest) = self.actors_join()?;
        self.is_requeued(&guest)?;
        self.is_preempted()?;
        self.reaches_its_time_limit()?;
        self.ends(&joined)
    }

    fn begins(&mut self) -> Result<()> {
        self.step("submitted; first checkpoint", |drill| {
            let progress = drill.run.goes_on(&drill.cluster)?;
            drill.run.is_placed_on([0, 1])?;
            Ok(progress.to_string())
        })?;
        if self.subject.insecure {
            return Ok(());
        }
        self.step("secrets are the owner's, on no command line", |drill| {
            drill.run.keeps_its_secrets()
        })
    }

    fn roles_are_killed(&mut self) -> Result<()> {
        let actor = format!("actor-{}-0", self.run.job);
        let store = self.run.dir.join("replay/0").to_string_lossy().into_owned();
        let run_dir = self.run.dir.to_string_lossy().into_owned();
        for (role, words) in [
            ("actor", ["actor", &actor]),
            ("replay-server", ["replay", &store]),
            ("learner", ["learner", &run_dir]),
        ] {
            self.step(&format!("kill -9 of the {role}; it came back"), |drill| {
                drill.run.kill(&words)
            })?;
            self.went_on()?;
        }
        Ok(())
    }

    fn a_node_fails(&mut self) -> Result<()> {
        self.step("node1 failed; the job runs again", |drill| {
            drill.cluster.fail_node(1)?;
            drill.started_again(1)
        })?;
        self.went_on()?;
        self.run.is_placed_on([0, 2])?;
        self.cluster.start_node(1)
    }

    fn a_second_job_is_refused(&mut self) -> Result<()> {
        self.step("node1 is back; another job on the run ended", |drill| {
            let before = drill.run.addresses()?;
            let second = drill.submit("run", 1)?;
            until_job(&drill.cluster, &second, "FAILED")?;
            ensure!(
                drill.run.addresses()? == before,
                "the second job took the run's addresses"
            );
            Ok("its addresses and secrets are as they were".into())
        })?;
        self.went_on()
    }

    /// Returns the job and the name of one of its actors.
    fn actors_join(&mut self) -> Result<(String, String)> {
        let joined = self.submit("join", 1)?;
        let guest = format!("actor-{joined}-0");
        self.step("actors of a third job joined the run", |drill| {
            until_job(&drill.cluster, &joined, "RUNNING")?;
            drill.run.stores_from(&guest, (0, 0))
        })?;
        Ok((joined, guest))
    }

    fn is_requeued(&mut self, guest: &str) -> Result<()> {
        self.step("scontrol requeue; all its roles stopped", |drill| {
            drill.cluster.control(["requeue", &drill.run.job])?;
            drill.drained()
        })?;
        let stored = self.run.progress()?.position_of(guest);
        self.runs_again(2)?;
        self.step("  the joined actors found it again", |drill| {
            drill.run.stores_from(guest, stored)
        })
    }

    fn is_preempted(&mut self) -> Result<()> {
        self.step("preempted; all its roles stopped", |drill| {
            let mut sbatch = drill.cluster.command("sbatch");
            sbatch.args(["--partition", URGENT, "--nodelist", &node_name(2)]);
            output(sbatch.args(["--output=/dev/null", "--wrap=true"]))?;
            until("the job has to stop", || drill.has_stopped(3))?;
            drill.drained()
        })?;
        self.runs_again(3)
    }

    fn reaches_its_time_limit(&mut self) -> Result<()> {
        let job = format!("JobId={}", self.run.job);
        self.step("time limit; the job requeued itself", |drill| {
            // Slurm counts in minutes, and warns a minute before.
            drill.cluster.control(["update", &job, "TimeLimit=2"])?;
            until("the job is requeued", || drill.has_stopped(4))?;
            drill
                .cluster
                .control(["update", &job, "TimeLimit=UNLIMITED"])?;
            Ok(String::new())
        })?;
        self.runs_again(4)
    }

    fn ends(&mut self, joined: &str) -> Result<()> {
        self.step("the last update; the job is COMPLETED", |drill| {
            Ok(drill.run.completes(&drill.cluster)?.to_string())
        })?;
        self.step("  the job that joined is COMPLETED too", |drill| {
            until_job(&drill.cluster, joined, "COMPLETED")?;
            Ok(String::new())
        })?;
        self.step("all checksums of all stores", |drill| {
            for shard in drill.run.shards() {
                output(drill.run.ask(["replay", "verify"]).arg(shard))?;
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

    fn went_on(&mut self) -> Result<()> {
        self.step("  the run went on", |drill| {
            Ok(drill.run.goes_on(&drill.cluster)?.to_string())
        })
    }

    fn runs_again(&mut self, restarts: u32) -> Result<()> {
        self.step("  the job runs again", |drill| {
            drill.started_again(restarts)
        })?;
        self.went_on()
    }

    /// Submits a job of the batch script.
    fn submit(&self, mode: &str, nodes: usize) -> Result<String> {
        let subject = &self.subject;
        let mut sbatch = self.cluster.command("sbatch");
        with_native(&mut sbatch, &subject.root);
        sbatch
            .args(["--parsable", &format!("--nodes={nodes}"), "--output"])
            .arg(self.dir.join("%j.out"))
            .arg(&subject.script)
            .args([Path::new(mode), &self.run.dir])
            .args(["--preset", "debug", "--set", "learner.prefill_steps=60"])
            .arg("--set")
            .arg(format!("learner.env_frames={}", subject.env_frames))
            .env("ISODREAM", &subject.binary)
            .env("ISODREAM_SHARDS", "2")
            .env("ISODREAM_ACTORS_PER_NODE", "2")
            .env("ISODREAM_INSECURE", subject.insecure.to_string())
            // All nodes are this one machine, and share its few cores.
            .env("OMP_NUM_THREADS", "1");
        let id = String::from_utf8(output(&mut sbatch)?)?;
        Ok(id.trim().to_owned())
    }

    /// Waits for the start after so many restarts, and says where it was.
    fn started_again(&self, restarts: u32) -> Result<String> {
        until("the job runs again", || {
            let job = self.cluster.job(&self.run.job)?;
            let again = job.field("Restarts") == restarts.to_string();
            Ok(
                (again && job.state() == "RUNNING")
                    .then(|| format!("on {}", job.field("NodeList"))),
            )
        })
    }

    /// Whether the job has ended for the `restarts`-th time, and will run again.
    fn has_stopped(&self, restarts: u32) -> Result<Option<()>> {
        let job = self.cluster.job(&self.run.job)?;
        let stopped = job.field("Restarts") == restarts.to_string() || job.state() == "PENDING";
        Ok(stopped.then_some(()))
    }

    /// Waits until no role of the job runs.
    fn drained(&self) -> Result<String> {
        let start = Instant::now();
        until("all roles have stopped", || {
            Ok((!self.run.has_processes()).then_some(()))
        })?;
        let seconds = start.elapsed().as_secs_f64();
        ensure!(
            seconds < DRAIN.as_secs_f64(),
            "the roles took {seconds:.0} s to stop, more than {} s",
            DRAIN.as_secs()
        );
        Ok(String::new())
    }

    /// Prints the table.
    pub(super) fn print(&self) {
        eprintln!("{:<44} {:>7}  seen", "done", "seconds");
        for (name, seconds, seen) in &self.rows {
            eprintln!("{name:<44} {seconds:>7.1}  {seen}");
        }
    }
}
