//! A disk without room.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use rustix::mount::{MountFlags, UnmountFlags, mount, unmount};

use super::{Context, RECOVERY, finish};
use crate::cluster::Cluster;
use crate::interrupt;
use crate::plan::Plan;
use crate::table::Row;
use crate::watch::Inserts;

/// How long the server may take to say that it waits.
const NOTICED: Duration = Duration::from_secs(60);

/// A small file system in memory. Dropping it unmounts it.
struct Disk {
    folder: tempfile::TempDir,
}

impl Disk {
    fn new(options: &std::ffi::CStr) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        mount(
            "chaos",
            folder.path(),
            "tmpfs",
            MountFlags::empty(),
            options,
        )
        .with_context(|| {
            format!(
                "cannot mount a tmpfs at {}; run as root",
                folder.path().display()
            )
        })?;
        Ok(Self { folder })
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        if let Err(error) = unmount(self.folder.path(), UnmountFlags::DETACH) {
            eprintln!("cannot unmount {}: {error}", self.folder.path().display());
        }
    }
}

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let disk = Disk::new(c"size=256m")?;
    let mut plan = Plan::usual(&[]);
    plan.first_store = Some(disk.path("store"));
    let cluster = Cluster::start(&context.binary, plan)?;
    let secs = context.hold.as_secs();
    let mut rows = [Row::new(
        "a replay-server's disk is full",
        &format!("a tmpfs of 256 MB, filled by a file that is removed after {secs} s"),
    )];
    rows[0].tried = 1;
    let recovered = fill(context, &cluster, &disk.path("ballast"), &mut rows[0]);
    rows[0].recovered(recovered);
    let begun = cluster.begun();
    finish(cluster, begun, 0, &mut rows)?;
    Ok(rows.into())
}

fn fill(context: &Context, cluster: &Cluster, ballast: &Path, row: &mut Row) -> Result<f64> {
    let start = cluster.role("replay-0")?.log_end();
    let before = cluster.watch.updates();
    let written = write_until_full(ballast)?;
    let waiting = interrupt::until("replay-0 says why it waits", NOTICED, || {
        let status = cluster.probe.replay(&cluster.layout.replays[0]);
        let why = status.map(|status| status.insert_waiting);
        Ok(why.filter(|why| why.contains("space") || why.contains("full")))
    })?;
    row.notes.push(format!(
        "filled with {written} bytes; its status says: {waiting}"
    ));
    interrupt::sleep(context.hold)?;
    let during = cluster.watch.updates();
    ensure!(
        during > before,
        "no update was made while one of two disks was full"
    );
    row.notes
        .push(format!("{} updates meanwhile", during - before));
    fs::remove_file(ballast)?;
    let at = Instant::now();
    let seconds = cluster.watch.recovery(at, Inserts::Into(0), RECOVERY)?;
    let log = cluster.role("replay-0")?.log_since(start)?;
    let lines: Vec<_> = log
        .lines()
        .filter(|line| line.contains("WARN") || line.contains("ERROR"))
        .collect();
    ensure!(
        !lines.is_empty(),
        "replay-0 has no line about its full disk"
    );
    row.notes.push(format!(
        "{} lines in its log, the first: {}",
        lines.len(),
        lines[0]
    ));
    ensure!(
        cluster.role("replay-0")?.exits().is_empty(),
        "replay-0 ended"
    );
    Ok(seconds)
}

/// Fills the disk to the last byte.
fn write_until_full(path: &Path) -> Result<u64> {
    let mut file = OpenOptions::new()
        .create_new(true)
        .append(true)
        .open(path)?;
    let mut written = 0;
    for bytes in [1 << 20, 4096, 1] {
        let block = vec![0; bytes];
        while file.write_all(&block).is_ok() {
            written += bytes as u64;
        }
    }
    Ok(written)
}
