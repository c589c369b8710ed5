//! A Slurm of its own on this machine: a controller and nodes with addresses in 127.0.0.0/8.

use std::fs::{self, File, Permissions};
use std::io::Read;
use std::net::TcpListener;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, ensure};

use crate::stage::{output, run};

/// Nodes; a run has two, the third takes over from one that fails.
pub(super) const NODES: usize = 3;

/// The partition whose jobs preempt those of the other.
pub(super) const URGENT: &str = "urgent";

/// What must be installed, and the Debian package that has it.
const PROGRAMS: [(&str, &str); 6] = [
    ("munged", "munge"),
    ("slurmctld", "slurmctld"),
    ("slurmd", "slurmd"),
    ("sbatch", "slurm-client"),
    ("unshare", "util-linux"),
    ("shellcheck", "shellcheck"),
];

/// Names what is missing, with the command that installs it.
///
/// # Errors
/// Where a program is missing, or this is not root, as whom `slurmd` starts jobs.
pub(super) fn require() -> Result<()> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let missing: Vec<&str> = PROGRAMS
        .iter()
        .filter(|(program, _)| !std::env::split_paths(&path).any(|dir| dir.join(program).exists()))
        .map(|(_, package)| *package)
        .collect();
    ensure!(
        missing.is_empty(),
        "Slurm is not installed: apt-get install --no-install-recommends {}",
        missing.join(" ")
    );
    ensure!(
        fs::metadata("/proc/self")?.uid() == 0,
        "slurmd starts jobs and nodes in namespaces of their own: run this as root, in a container if need be"
    );
    Ok(())
}

/// Controller, nodes and the daemon that signs their messages; dropping it kills all of them and their jobs.
#[derive(Debug)]
pub(super) struct Cluster {
    dir: PathBuf,
    nodes: [Option<Child>; NODES],
    controller: Vec<Child>,
}

/// What Slurm says of a job.
#[derive(Debug, Clone)]
pub(super) struct Job(String);

impl Job {
    /// A field of `scontrol show job`; empty where there is none.
    pub(super) fn field(&self, name: &str) -> &str {
        self.0
            .split_whitespace()
            .find_map(|word| word.strip_prefix(name)?.strip_prefix('='))
            .unwrap_or_default()
    }

    pub(super) fn state(&self) -> &str {
        self.field("JobState")
    }
}

impl Cluster {
    /// Starts it in the empty folder `dir`.
    pub(super) fn start(dir: &Path) -> Result<Self> {
        let mut cluster = Self {
            dir: dir.to_owned(),
            nodes: [const { None }; NODES],
            controller: Vec::new(),
        };
        let keys = dir.join("munge");
        fs::create_dir(&keys)?;
        fs::set_permissions(&keys, Permissions::from_mode(0o700))?;
        fs::write(keys.join("key"), random_bytes()?)?;
        fs::set_permissions(keys.join("key"), Permissions::from_mode(0o400))?;
        fs::create_dir(dir.join("state"))?;
        fs::write(dir.join("slurm.conf"), cluster.configuration()?)?;

        let option = |name: &str, path: PathBuf| format!("--{name}={}", path.display());
        let mut munged = Command::new("munged");
        munged.arg("--foreground").args([
            option("socket", dir.join("munge.socket")),
            option("key-file", keys.join("key")),
            option("pid-file", keys.join("pid")),
            option("seed-file", keys.join("seed")),
        ]);
        let munged = cluster.daemon(&mut munged, "munged")?;
        cluster.controller.push(munged);
        let slurmctld = cluster.daemon(Command::new("slurmctld").arg("-D"), "slurmctld")?;
        cluster.controller.push(slurmctld);
        for node in 0..NODES {
            cluster.start_node(node)?;
        }
        Ok(cluster)
    }

    /// Starts a node, which has a process namespace of its own, as another machine would.
    pub(super) fn start_node(&mut self, node: usize) -> Result<()> {
        let name = node_name(node);
        let mut unshare = Command::new("unshare");
        unshare
            .args(["--fork", "--pid", "--mount-proc", "--kill-child"])
            .args(["slurmd", "-D", "-N", &name]);
        self.nodes[node] = Some(self.daemon(&mut unshare, &name)?);
        Ok(())
    }

    /// Takes a node away with everything that runs on it, as a power failure would.
    pub(super) fn fail_node(&mut self, node: usize) -> Result<()> {
        let child = self.nodes[node].take();
        stop(&mut child.with_context(|| format!("{} does not run", node_name(node)))?);
        Ok(())
    }

    /// A program of Slurm that talks to this cluster.
    pub(super) fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("SLURM_CONF", self.dir.join("slurm.conf"));
        command
    }

    /// How many nodes wait for jobs; 0 also while the controller does not answer yet.
    pub(super) fn idle_nodes(&self) -> usize {
        let mut sinfo = self.command("sinfo");
        sinfo.args(["--noheader", "--Node", "--partition", URGENT, "--format=%T"]);
        sinfo.output().map_or(0, |found| {
            let states = String::from_utf8_lossy(&found.stdout);
            states
                .lines()
                .filter(|state| state.trim() == "idle")
                .count()
        })
    }

    pub(super) fn job(&self, id: &str) -> Result<Job> {
        let found = output(
            self.command("scontrol")
                .args(["--oneliner", "show", "job", id]),
        )?;
        Ok(Job(String::from_utf8(found)?))
    }

    /// `scontrol ARGS...`.
    pub(super) fn control<'a>(&self, args: impl IntoIterator<Item = &'a str>) -> Result<()> {
        run(self.command("scontrol").args(args))
    }

    fn daemon(&self, command: &mut Command, name: &str) -> Result<Child> {
        let log = File::create(self.dir.join(format!("{name}.log")))?;
        command
            .env("SLURM_CONF", self.dir.join("slurm.conf"))
            .stdin(Stdio::null())
            .stdout(log.try_clone()?)
            .stderr(log)
            .spawn()
            .with_context(|| format!("cannot start {name}"))
    }

    fn configuration(&self) -> Result<String> {
        let dir = self.dir.display();
        let host = fs::read_to_string("/proc/sys/kernel/hostname")?;
        let host = host.trim().split('.').next().unwrap_or_default();
        let ports = free_ports(1 + NODES)?;
        // Ports of a run follow from the number of its job, and differ for every cluster on this machine.
        let first_job = 1 + std::process::id() % 1400;
        // Short times: a requeued job waits until its old credentials expire, and for the next round of the scheduler.
        let mut text = format!(
            "ClusterName=isodream\n\
             SlurmctldHost={host}(127.0.0.1)\n\
             SlurmctldPort={}\n\
             SlurmctldPidFile={dir}/slurmctld.pid\n\
             SlurmUser=root\n\
             StateSaveLocation={dir}/state\n\
             SlurmdSpoolDir={dir}/spool-%n\n\
             SlurmdPidFile={dir}/slurmd-%n.pid\n\
             SlurmdTimeout=15\n\
             AuthType=auth/munge\n\
             AuthInfo=socket={dir}/munge.socket,cred_expire=5\n\
             ProctrackType=proctrack/linuxproc\n\
             TaskPlugin=task/none\n\
             SwitchType=switch/none\n\
             MpiDefault=none\n\
             SelectType=select/cons_tres\n\
             SelectTypeParameters=CR_Core\n\
             SchedulerParameters=bf_interval=2,sched_interval=2\n\
             ReturnToService=2\n\
             FirstJobId={first_job}\n\
             PreemptType=preempt/partition_prio\n\
             PreemptMode=REQUEUE\n\
             PartitionName=main Nodes=ALL Default=YES PriorityTier=1 GraceTime=30\n\
             PartitionName={URGENT} Nodes=ALL PriorityTier=2 PreemptMode=OFF\n",
            ports[0]
        );
        for node in 0..NODES {
            text += &format!(
                "NodeName={} NodeHostname={host} NodeAddr={} Port={} CPUs=2\n",
                node_name(node),
                address(node),
                ports[1 + node]
            );
        }
        Ok(text)
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        self.nodes.iter_mut().flatten().for_each(stop);
        self.controller.iter_mut().rev().for_each(stop);
    }
}

/// Kills a daemon. Of a node this ends the first process of its namespace, and so all others.
fn stop(child: &mut Child) {
    // Both fail only where it has ended already.
    let _ = child.kill();
    let _ = child.wait();
}

pub(super) fn node_name(node: usize) -> String {
    format!("node{node}")
}

/// Where a node's roles listen.
pub(super) fn address(node: usize) -> String {
    format!("127.0.0.{}", node + 2)
}

fn free_ports(count: usize) -> Result<Vec<u16>> {
    let held: Vec<TcpListener> = (0..count)
        .map(|_| TcpListener::bind("0.0.0.0:0"))
        .collect::<Result<_, _>>()?;
    held.iter()
        .map(|listener| Ok(listener.local_addr()?.port()))
        .collect()
}

fn random_bytes() -> Result<[u8; 1024]> {
    let mut bytes = [0; 1024];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_of_a_job_are_found_by_their_whole_name() {
        let job = Job("JobId=7 Requeue=1 Restarts=2 JobState=RUNNING NodeList=node[0,2]\n".into());
        assert_eq!(job.state(), "RUNNING");
        assert_eq!(job.field("Restarts"), "2");
        assert_eq!(job.field("NodeList"), "node[0,2]");
        assert_eq!(job.field("State"), "");
        assert_eq!(job.field("Job"), "");
    }
}
