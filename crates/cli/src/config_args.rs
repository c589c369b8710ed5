//! The options that every role takes its configuration from.

use std::path::PathBuf;

use clap::Args;
use isodream_core::Config;
use isodream_core::config::{ConfigError, Source};

/// Defaults < preset < file < single settings.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct ConfigArgs {
    /// Preset: paper, paper-dmc, quick or debug
    #[arg(long)]
    pub(crate) preset: Option<String>,
    /// A TOML file
    #[arg(long)]
    pub(crate) config: Option<PathBuf>,
    /// A single setting, for example learner.batch_size=16; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
}

impl ConfigArgs {
    pub(crate) fn load(&self) -> Result<Config, ConfigError> {
        Config::load(&Source {
            preset: self.preset.clone(),
            file: self.config.clone(),
            set: self.set.clone(),
        })
    }

    /// The same options for another process.
    pub(crate) fn args(&self) -> Vec<String> {
        let preset = self
            .preset
            .iter()
            .flat_map(|preset| ["--preset".to_owned(), preset.clone()]);
        let file = self.config.iter().map(|file| file.display().to_string());
        let file = file.flat_map(|file| ["--config".to_owned(), file]);
        let set = self
            .set
            .iter()
            .flat_map(|set| ["--set".to_owned(), set.clone()]);
        preset.chain(file).chain(set).collect()
    }

    /// Whether nothing was said.
    #[cfg(feature = "torch")]
    pub(crate) fn is_empty(&self) -> bool {
        self.preset.is_none() && self.config.is_none() && self.set.is_empty()
    }
}
