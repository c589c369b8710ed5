//! The runs below a folder.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use isodream_core::Config;
use serde::{Deserialize, Serialize};

use crate::series::{Metrics, Series};

/// Folders between the root and a run at most.
const DEPTH: usize = 4;

/// What `/api/runs` answers.
#[derive(Debug, Serialize)]
pub struct Overview {
    /// The folder that was looked through.
    pub root: String,
    /// Whether `/api/live` has something to tell.
    pub live: bool,
    /// All runs, the one that was written last first.
    pub runs: Vec<Run>,
}

/// One run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Run {
    /// Path below the root; `.` where the root is a run itself.
    pub id: String,
    /// Runs that differ in their seed alone share it.
    pub group: String,
    /// Id of the environment.
    pub env: String,
    /// Root of the seed tree.
    pub seed: u64,
    /// Environment frames so far.
    pub frames: f64,
    /// Environment frames after which it ends.
    pub total_frames: u64,
    /// When metrics were written last, seconds since 1970.
    pub written: f64,
    /// Names of its metrics.
    pub metrics: Vec<String>,
    /// The final comparison by policy: `trained`, and the scripted drivers; empty before it is made.
    pub evaluation: BTreeMap<String, Evaluation>,
}

/// Scores of one policy in a run's final comparison.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Mean return.
    pub return_mean: f64,
    /// Standard deviation of the returns.
    pub return_std: f64,
}

/// Reads runs, and remembers what it read.
#[derive(Debug)]
pub(crate) struct Runs {
    root: PathBuf,
    metrics: Mutex<BTreeMap<String, Metrics>>,
}

impl Runs {
    pub(crate) fn new(root: PathBuf) -> Self {
        Self {
            root,
            metrics: Mutex::default(),
        }
    }

    pub(crate) fn root(&self) -> &Path {
        &self.root
    }

    /// All runs, the one that was written last first.
    pub(crate) fn list(&self) -> std::io::Result<Vec<Run>> {
        let mut folders = Vec::new();
        find(&self.root, DEPTH, &mut folders);
        let mut runs = Vec::new();
        for folder in folders {
            // A run that is just being made, or damaged, is none yet.
            if let Ok(config) = Config::from_file(&folder.join("config.toml")) {
                runs.push(self.read(&folder, &config)?);
            }
        }
        runs.sort_by(|a, b| b.written.total_cmp(&a.written).then(a.id.cmp(&b.id)));
        Ok(runs)
    }

    /// The folder of the run `id`; none where there is no such run below the root, whatever `id` says.
    pub(crate) fn folder(&self, id: &str) -> Option<PathBuf> {
        let folder = match id {
            "." => self.root.clone(),
            _ => self.root.join(id),
        };
        let below = Path::new(id).components();
        let mut names = below.filter(|part| *part != Component::CurDir);
        let stays_below = names.all(|part| matches!(part, Component::Normal(_)));
        (stays_below && is_run(&folder) && self.id(&folder) == id).then_some(folder)
    }

    pub(crate) fn series(&self, folder: &Path, metric: &str) -> std::io::Result<Series> {
        self.with_metrics(folder, |metrics| metrics.series(metric))
    }

    fn read(&self, folder: &Path, config: &Config) -> std::io::Result<Run> {
        let (frames, metrics) =
            self.with_metrics(folder, |metrics| (metrics.frames(), metrics.names()))?;
        let id = self.id(folder);
        Ok(Run {
            group: group(&id, config.seed),
            id,
            env: config.env.id.clone(),
            seed: config.seed,
            frames,
            total_frames: config.learner.env_frames,
            written: written(&folder.join("metrics.jsonl")),
            metrics,
            evaluation: evaluation(&folder.join("evaluation.json")),
        })
    }

    fn with_metrics<T>(
        &self,
        folder: &Path,
        look: impl FnOnce(&Metrics) -> T,
    ) -> std::io::Result<T> {
        let mut all = self.metrics.lock().unwrap_or_else(PoisonError::into_inner);
        let metrics = all
            .entry(self.id(folder))
            .or_insert_with(|| Metrics::of(folder));
        metrics.refresh()?;
        Ok(look(metrics))
    }

    fn id(&self, folder: &Path) -> String {
        let below = folder.strip_prefix(&self.root).unwrap_or(folder);
        match below.to_str() {
            Some("") | None => ".".to_owned(),
            Some(path) => path.to_owned(),
        }
    }
}

fn is_run(folder: &Path) -> bool {
    folder.join("config.toml").is_file()
}

/// Adds `folder`, if it is a run, or else the runs below it.
fn find(folder: &Path, depth: usize, found: &mut Vec<PathBuf>) {
    if is_run(folder) {
        found.push(folder.to_owned());
        return;
    }
    let Some(depth) = depth.checked_sub(1) else {
        return;
    };
    let Ok(entries) = std::fs::read_dir(folder) else {
        return;
    };
    let mut below: Vec<PathBuf> = entries
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        .map(|entry| entry.path())
        .collect();
    below.sort();
    for folder in below {
        find(&folder, depth, found);
    }
}

/// The id without its seed: `driving/seed-2` and `driving-s2` with seed 2 are of the group `driving`.
fn group(id: &str, seed: u64) -> String {
    let seed = seed.to_string();
    let without = id.strip_suffix(&seed).map(|rest| {
        let rest = rest.trim_end_matches(['-', '_', '=']);
        let rest = rest.strip_suffix("seed").unwrap_or(rest);
        let rest = rest.strip_suffix("-s").unwrap_or(rest);
        rest.trim_end_matches(['-', '_', '/'])
    });
    match without {
        Some(rest) if !rest.is_empty() => rest.to_owned(),
        _ => id.to_owned(),
    }
}

fn written(path: &Path) -> f64 {
    let modified = std::fs::metadata(path).and_then(|metadata| metadata.modified());
    let since = modified
        .unwrap_or(SystemTime::UNIX_EPOCH)
        .duration_since(UNIX_EPOCH);
    since.map_or(0.0, |since| since.as_secs_f64())
}

/// What `isodream eval` and `isodream train` write, as far as it is shown.
#[derive(Debug, Deserialize)]
struct Comparison {
    policies: BTreeMap<String, Evaluation>,
}

fn evaluation(path: &Path) -> BTreeMap<String, Evaluation> {
    let text = std::fs::read(path).unwrap_or_default();
    serde_json::from_slice(&text)
        .map_or_else(|_| BTreeMap::new(), |found: Comparison| found.policies)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_that_differ_in_their_seed_share_a_group() {
        for id in [
            "driving/seed-12",
            "driving/seed12",
            "driving/12",
            "driving-s12",
            "driving_12",
        ] {
            assert_eq!(group(id, 12), "driving", "{id}");
        }
        assert_eq!(group("driving", 12), "driving");
        assert_eq!(group("12", 12), "12");
        assert_eq!(group("tau-5/seed-1", 1), "tau-5");
        assert_eq!(group("tau-5", 0), "tau-5");
    }
}
