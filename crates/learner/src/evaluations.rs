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

/// Environments name their measurements as they like: one that is called as a column of every table becomes `env_NAME`,
/// so that an environment's own `score` never passes for the return.
pub(crate) fn set_apart(report: &mut v1::EpisodeReport) {
    for column in COLUMNS {
        if let Some(value) = report.metrics.remove(column) {
            report.metrics.insert(format!("env_{column}"), value);
        }
    }
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_environments_own_score_is_not_the_return() {
        let run = tempfile::tempdir().unwrap();
        let mut report = v1::EpisodeReport {
            score: 4.5,
            length: 20,
            metrics: [("score".to_owned(), 9_000.0), ("speed".to_owned(), 3.0)].into(),
            ..v1::EpisodeReport::default()
        };
        set_apart(&mut report);
        Evaluations::new(run.path()).add(400, &report).unwrap();
        let table = std::fs::read_to_string(run.path().join("evaluations.csv")).unwrap();
        assert_eq!(
            table,
            "frames,updates,episode_id,score,length,end_reason,env_score,speed\n400,0,0,4.5,20,,9000,3\n"
        );
    }
}
