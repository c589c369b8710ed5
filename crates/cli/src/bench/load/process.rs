//! What a process has used, as Linux tells it.

use std::fs;

use anyhow::Context;
use rustix::param::clock_ticks_per_second;
use serde::Serialize;

/// What a process has used so far, and what it holds now.
#[derive(Debug, Clone, Copy)]
pub(super) struct Usage {
    cpu_seconds: f64,
    rss_bytes: u64,
    own_bytes: u64,
    threads: u64,
    files: u64,
    sockets: u64,
}

/// A process over the time of the measurement.
#[derive(Debug, Clone, Serialize)]
pub(super) struct ProcessLoad {
    pub(super) name: String,
    /// CPU seconds per second.
    pub(super) cpus: f64,
    /// Memory at the end, mapped files included.
    pub(super) rss_bytes: u64,
    /// Memory at the end that no file stands for.
    pub(super) own_bytes: u64,
    pub(super) threads: u64,
    /// Open file descriptors, sockets included.
    pub(super) files: u64,
    pub(super) sockets: u64,
}

impl Usage {
    pub(super) fn of(pid: u32) -> anyhow::Result<Self> {
        let read = |what: &str| {
            let path = format!("/proc/{pid}/{what}");
            fs::read_to_string(&path).with_context(|| {
                format!("cannot read {path}: the process ended, or this is not Linux")
            })
        };
        let stat = read("stat")?;
        // Its second field, the name, may hold blanks and ends with the last bracket.
        let fields: Vec<&str> = stat
            .rsplit_once(')')
            .map_or("", |(_, rest)| rest)
            .split_whitespace()
            .collect();
        let ticks = |index: usize| -> anyhow::Result<u64> {
            let field = fields
                .get(index)
                .context("/proc has a line that is too short")?;
            Ok(field.parse()?)
        };
        let status = read("status")?;
        let number = |name: &str| -> anyhow::Result<u64> {
            let number = status
                .lines()
                .find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))
                .and_then(|rest| rest.split_whitespace().next())
                .with_context(|| format!("/proc/{pid}/status has no {name}"))?;
            Ok(number.parse()?)
        };
        let mut files = 0;
        let mut sockets = 0;
        for entry in fs::read_dir(format!("/proc/{pid}/fd"))? {
            files += 1;
            // One that was closed meanwhile is no socket any more.
            let target = fs::read_link(entry?.path()).unwrap_or_default();
            sockets += u64::from(target.to_string_lossy().starts_with("socket:"));
        }
        Ok(Self {
            cpu_seconds: (ticks(11)? + ticks(12)?) as f64 / clock_ticks_per_second() as f64,
            rss_bytes: 1024 * number("VmRSS")?,
            own_bytes: 1024 * number("RssAnon")?,
            threads: number("Threads")?,
            files,
            sockets,
        })
    }

    /// What was used since `before`, `seconds` ago.
    pub(super) fn since(&self, before: &Self, name: &str, seconds: f64) -> ProcessLoad {
        ProcessLoad {
            name: name.to_owned(),
            cpus: (self.cpu_seconds - before.cpu_seconds) / seconds,
            rss_bytes: self.rss_bytes,
            own_bytes: self.own_bytes,
            threads: self.threads,
            files: self.files,
            sockets: self.sockets,
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn work_memory_and_sockets_of_a_process_are_seen() {
        let pid = std::process::id();
        let before = Usage::of(pid).unwrap();
        let _listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let memory = vec![1_u8; 64 << 20];
        let begun = std::time::Instant::now();
        let mut sum = 0_u64;
        while begun.elapsed().as_millis() < 200 {
            sum += memory.iter().map(|&byte| u64::from(byte)).sum::<u64>();
        }
        assert!(sum > 0);
        let after = Usage::of(pid).unwrap();
        let load = after.since(&before, "me", begun.elapsed().as_secs_f64());
        assert!(load.cpus > 0.05, "{load:?}");
        assert!(
            after.own_bytes >= before.own_bytes + (60 << 20),
            "{after:?}"
        );
        assert!(after.sockets > before.sockets && after.files > before.files);
        assert!(Usage::of(u32::MAX).is_err());
    }
}
