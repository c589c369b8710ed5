//! `evaluations.csv`: a row for each evaluation episode.

use std::path::{Path, PathBuf};

use isodream_proto::v1;
use isodream_telemetry::CsvLog;

/// Columns that every environment has; those of its own measurements follow, by name.
const COLUMNS: [&str; 6] = [
    "frames",
    "updates",
    "episode_id",
    "score",
    "length",
    "end_reason",
];

/// The table, which begins with the first episode: that tells what the environment measures.
#[derive(Debug)]
pub(crate) struct Evaluations {
    path: PathBuf,
    log: Option<CsvLog>,
}

impl Evaluations {
    pub(crate) fn new(run_dir: &Path) -> Self {
        Self {
            path: run_dir.join("evaluations.csv"),
            log: None,
        }
    }

    /// Appends an episode that ended when the run had seen `frames`.
    pub(crate) fn add(&mut self, frames: u64, report: &v1::EpisodeReport) -> anyhow::Result<()> {
        let mut measured: Vec<&str> = report.metrics.keys().map(String::as_str).collect();
        measured.sort_unstable();
        let log = match &mut self.log {
            Some(log) => log,
            None => {
                let columns = [&COLUMNS[..], &measured].concat();
                self.log.insert(CsvLog::open(&self.path, &columns)?)
            }
        };
        let updates = report.policy.map_or(0, |policy| policy.version);
        let mut fields = vec![
            ("frames", frames.to_string()),
            ("updates", updates.to_string()),
            ("episode_id", report.episode_id.to_string()),
            ("score", report.score.to_string()),
            ("length", report.length.to_string()),
            ("end_reason", report.end_reason.clone()),
        ];
        let metrics = report.metrics.iter();
        fields.extend(metrics.map(|(name, value)| (name.as_str(), value.to_string())));
        Ok(log.row(&fields)?)
    }
}
