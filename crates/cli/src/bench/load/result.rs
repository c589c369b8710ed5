//! What the load generator found.

use serde::Serialize;

use super::board::{FanOut, Spread};
use super::commits::CommitLoad;
use super::process::ProcessLoad;

/// MB are 10^6 bytes as they travel, compressed.
#[derive(Debug, Serialize)]
pub(super) struct LoadBench {
    pub(super) actors: u64,
    pub(super) replay_servers: usize,
    pub(super) learners: u16,
    /// Whether policies come from the replay-servers.
    pub(super) relayed: bool,
    pub(super) seconds: f64,
    /// Of all actors together; none where they append as fast as chunks become durable.
    pub(super) offered_steps_per_s: Option<f64>,
    /// From the first connection until every actor had a durable chunk and a policy.
    pub(super) join_seconds: f64,
    pub(super) appended_steps_per_s: f64,
    pub(super) appended_mb_per_s: f64,
    pub(super) bytes_per_step: f64,
    /// From when a chunk was due until it is durable.
    pub(super) append: Spread,
    /// Of own replay-servers, together.
    pub(super) commits: CommitLoad,
    pub(super) policy_bytes: usize,
    pub(super) policy_mb_per_s: f64,
    pub(super) fan_out: FanOut,
    pub(super) reports_per_s: f64,
    pub(super) lost_reports: u64,
    pub(super) sampled_steps_per_s: f64,
    pub(super) sampled_mb_per_s: f64,
    /// This process, and those that it started.
    pub(super) processes: Vec<ProcessLoad>,
}

impl LoadBench {
    pub(super) fn table(&self) -> String {
        let mut lines = vec![format!(
            "{} actors, {} replay-servers{}, {} sampling learners, {:.0} s; all joined after {:.1} s",
            self.actors,
            self.replay_servers,
            if self.relayed {
                " that hand on policies"
            } else {
                ""
            },
            self.learners,
            self.seconds,
            self.join_seconds
        )];
        let offered = self
            .offered_steps_per_s
            .map_or_else(String::new, |steps| format!(" of {steps:.0} offered"));
        lines.push(format!(
            "appended, durable: {:.0} steps/s{offered}, {:.1} MB/s, {:.0} bytes per step",
            self.appended_steps_per_s, self.appended_mb_per_s, self.bytes_per_step
        ));
        lines.push(format!(
            "own servers: {:.0} fdatasync/s of {:.1} chunks and {:.1} ms each",
            self.commits.per_s, self.commits.chunks_each, self.commits.ms_each
        ));
        if self.learners > 0 {
            lines.push(format!(
                "sampled: {:.0} steps/s, {:.1} MB/s",
                self.sampled_steps_per_s, self.sampled_mb_per_s
            ));
        }
        lines.push(format!(
            "policies: {:.1} MB each, {} published, {} reached every actor, {:.0} MB/s; reports: {:.1} per s, {} lost",
            self.policy_bytes as f64 / 1e6,
            self.fan_out.published,
            self.fan_out.complete,
            self.policy_mb_per_s,
            self.reports_per_s,
            self.lost_reports
        ));
        lines.push(format!(
            "{:<36} {:>10} {:>10} {:>10} {:>10}",
            "ms", "count", "p50", "p99", "max"
        ));
        let spreads = [
            ("append: due until durable", self.append),
            ("policy: published until verified", self.fan_out.actors),
            ("policy: until the last actor", self.fan_out.last_actor),
        ];
        lines.extend(spreads.map(|(name, spread)| {
            format!(
                "{name:<36} {:>10} {:>10.1} {:>10.1} {:>10.1}",
                spread.count, spread.p50_ms, spread.p99_ms, spread.max_ms
            )
        }));
        lines.push(format!(
            "{:<20} {:>8} {:>10} {:>10} {:>8} {:>8} {:>8}",
            "process", "CPUs", "memory MB", "own MB", "threads", "files", "sockets"
        ));
        lines.extend(self.processes.iter().map(|process| {
            format!(
                "{:<20} {:>8.2} {:>10.0} {:>10.0} {:>8} {:>8} {:>8}",
                process.name,
                process.cpus,
                process.rss_bytes as f64 / 1e6,
                process.own_bytes as f64 / 1e6,
                process.threads,
                process.files,
                process.sockets
            )
        }));
        lines.join("\n")
    }
}
