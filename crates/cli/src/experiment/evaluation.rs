//! Evaluations as the runs of an experiment leave them.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Context;
use serde::Deserialize;

/// What `isodream train` and `isodream eval` write, as far as it is told here.
#[derive(Debug, Deserialize)]
pub(super) struct Evaluation {
    pub(super) episodes: u64,
    pub(super) env_frames: u64,
    pub(super) updates: u64,
    policies: BTreeMap<String, Scores>,
}

#[derive(Debug, Deserialize)]
struct Scores {
    return_mean: f64,
}

impl Evaluation {
    pub(super) fn read(path: &Path) -> anyhow::Result<Self> {
        let text =
            std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        serde_json::from_slice(&text)
            .with_context(|| format!("{} is damaged; delete it and run again", path.display()))
    }

    /// Mean return of the trained policy.
    pub(super) fn trained(&self) -> Option<f64> {
        Some(self.policies.get("trained")?.return_mean)
    }
}
