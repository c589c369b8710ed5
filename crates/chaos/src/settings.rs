//! The configuration that all roles of a run share.

use anyhow::Result;
use clap::Args;
use isodream_core::Config;
use isodream_core::config::Source;

/// A preset and what differs from it.
#[derive(Debug, Clone, Args)]
pub(crate) struct Settings {
    /// Preset
    #[arg(long, default_value = "debug")]
    pub(crate) preset: String,
    /// A single setting; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
}

impl Settings {
    /// The debug preset without an end, with small checkpoints that come often, and with fewer updates per step, so
    /// that more is inserted while the learner keeps up. `prefill_steps` counts in each of `replays` servers.
    pub(crate) fn for_faults(replays: usize, more: &[&str]) -> Self {
        let prefill = format!("learner.prefill_steps={}", 120 / replays.max(1));
        let common = [
            "learner.env_frames=1000000000",
            "learner.replay_ratio=0.05",
            "learner.batch_size=2",
            "learner.log_interval=100",
            &prefill,
        ];
        Self {
            preset: "debug".into(),
            set: common.iter().chain(more).map(|&set| set.into()).collect(),
        }
    }

    /// What every role and ledger actor is given.
    pub(crate) fn args(&self) -> Vec<String> {
        let mut args = vec!["--preset".into(), self.preset.clone()];
        for set in &self.set {
            args.extend(["--set".into(), set.clone()]);
        }
        args
    }

    pub(crate) fn load(&self) -> Result<Config> {
        Ok(Config::load(&Source {
            preset: Some(self.preset.clone()),
            file: None,
            set: self.set.clone(),
        })?)
    }
}
