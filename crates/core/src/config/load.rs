//! Merging defaults, preset, file and `--set` into a checked [`Config`].

use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use toml::{Table, Value};

use super::{Config, TableConfig};

/// Names of the presets and their settings over the defaults; later texts win.
pub const PRESETS: &[(&str, &[&str])] = &[
    ("paper", &[include_str!("../../presets/paper.toml")]),
    ("paper-dmc", &[include_str!("../../presets/paper-dmc.toml")]),
    ("quick", &[QUICK]),
    (
        "quick-dmc",
        &[QUICK, include_str!("../../presets/quick-dmc.toml")],
    ),
    ("debug", &[include_str!("../../presets/debug.toml")]),
];

const QUICK: &str = include_str!("../../presets/quick.toml");

/// Where settings come from; later fields win.
#[derive(Debug, Clone, Default)]
pub struct Source {
    /// Name of a preset.
    pub preset: Option<String>,
    /// A TOML file.
    pub file: Option<PathBuf>,
    /// `a.b=v` settings, the value in TOML syntax (a bare word is a string).
    pub set: Vec<String>,
}

/// A setting that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// No preset of that name.
    #[error("unknown preset `{name}`; known: {known}")]
    UnknownPreset {
        /// What was asked for.
        name: String,
        /// What there is.
        known: String,
    },
    /// The file cannot be read.
    #[error("cannot read configuration {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Not TOML, or a value of the wrong type.
    #[error("{origin}: {message}")]
    Invalid {
        /// Preset, file or setting.
        origin: String,
        /// What is wrong.
        message: String,
    },
    /// A key that no field has.
    #[error("{origin}: unknown key `{key}`; did you mean `{nearest}`?")]
    UnknownKey {
        /// Preset, file or setting.
        origin: String,
        /// The key.
        key: String,
        /// The nearest known key.
        nearest: String,
    },
}

impl Config {
    /// Resolves a configuration.
    ///
    /// # Errors
    /// [`ConfigError`] names the source, the key and the cure.
    pub fn load(source: &Source) -> Result<Self, ConfigError> {
        let mut merged = defaults();
        if let Some(name) = &source.preset {
            let (_, texts) = PRESETS
                .iter()
                .find(|(known, _)| known == name)
                .ok_or_else(|| ConfigError::UnknownPreset {
                    name: name.clone(),
                    known: PRESETS
                        .iter()
                        .map(|(name, _)| *name)
                        .collect::<Vec<_>>()
                        .join(", "),
                })?;
            for text in *texts {
                merge_text(&mut merged, text, &format!("preset {name}"))?;
            }
        }
        if let Some(path) = &source.file {
            let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Read {
                path: path.clone(),
                source,
            })?;
            merge_text(&mut merged, &text, &path.display().to_string())?;
        }
        Self::resolve(merged, &source.set)
    }

    /// This configuration with some `a.b=v` settings changed.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn with(&self, set: &[String]) -> Result<Self, ConfigError> {
        let merged = Table::try_from(self).expect("a configuration is plain data");
        Self::resolve(merged, set)
    }

    fn resolve(mut merged: Table, set: &[String]) -> Result<Self, ConfigError> {
        for setting in set {
            merge_setting(&mut merged, setting)?;
        }
        let config: Self =
            merged
                .try_into()
                .map_err(|error: toml::de::Error| ConfigError::Invalid {
                    origin: "configuration".into(),
                    message: error.message().to_owned(),
                })?;
        config.check()?;
        Ok(config)
    }

    /// Reads a resolved configuration, as [`Self::to_toml`] wrote it.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn from_file(path: &Path) -> Result<Self, ConfigError> {
        Self::load(&Source {
            file: Some(path.to_owned()),
            ..Source::default()
        })
    }

    /// The resolved configuration as TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a configuration is plain data")
    }

    /// Hexadecimal hash of what the parameters' names and shapes, and the way of acting, depend on.
    pub fn model_hash(&self) -> String {
        let acting = toml::to_string(&self.model).expect("a configuration is plain data");
        let digest = Sha256::digest(format!("{acting}{}", self.behavior.rollout_window));
        digest[..8]
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect()
    }
}

/// Where users choose the names.
const TABLES_PREFIX: &str = "replay.tables.";

fn defaults() -> Table {
    Table::try_from(Config::default()).expect("a configuration is plain data")
}

fn merge_text(into: &mut Table, text: &str, origin: &str) -> Result<(), ConfigError> {
    let table: Table = text
        .parse()
        .map_err(|error: toml::de::Error| ConfigError::Invalid {
            origin: origin.to_owned(),
            message: error.to_string(),
        })?;
    merge(into, table, "", origin)
}

fn merge_setting(into: &mut Table, setting: &str) -> Result<(), ConfigError> {
    let origin = format!("--set {setting}");
    let (key, value) = setting
        .split_once('=')
        .ok_or_else(|| ConfigError::Invalid {
            origin: origin.clone(),
            message: "expected key=value, for example learner.batch_size=16".into(),
        })?;
    let value = format!("v = {value}")
        .parse::<Table>()
        .ok()
        .and_then(|mut table| table.remove("v"))
        .unwrap_or_else(|| Value::String(value.to_owned()));
    let table = key.trim().rsplit('.').fold(value, |inner, name| {
        Value::Table(Table::from_iter([(name.to_owned(), inner)]))
    });
    match table {
        Value::Table(table) => merge(into, table, "", &origin),
        _ => Ok(()),
    }
}

/// Merges `from` into `into`, which holds every known key with a value of its type.
fn merge(into: &mut Table, from: Table, prefix: &str, origin: &str) -> Result<(), ConfigError> {
    for (name, value) in from {
        let key = format!("{prefix}{name}");
        if prefix == TABLES_PREFIX && !into.contains_key(&name) {
            let table = Table::try_from(TableConfig::default());
            let table = table.expect("a configuration is plain data");
            into.insert(name.clone(), Value::Table(table));
        }
        let Some(old) = into.get_mut(&name) else {
            return Err(ConfigError::UnknownKey {
                origin: origin.to_owned(),
                nearest: nearest(&key),
                key,
            });
        };
        *old = match (&mut *old, value) {
            (Value::Table(old), Value::Table(new)) => {
                merge(old, new, &format!("{key}."), origin)?;
                continue;
            }
            (Value::Float(_), Value::Integer(new)) => Value::Float(new as f64),
            (old, new) if old.type_str() == new.type_str() => new,
            (old, new) => {
                return Err(ConfigError::Invalid {
                    origin: origin.to_owned(),
                    message: format!(
                        "`{key}` takes a value of type {}, not {}",
                        old.type_str(),
                        new.type_str()
                    ),
                });
            }
        };
    }
    Ok(())
}

/// The known key or table nearest to `key`, by edit distance; a field's own name weighs as much as its full path.
fn nearest(key: &str) -> String {
    let mut known = Vec::new();
    collect_keys(&defaults(), "", &mut known);
    let last = |path: &str| path.rsplit('.').next().unwrap_or(path).to_owned();
    known
        .into_iter()
        .min_by_key(|candidate| {
            strsim::damerau_levenshtein(candidate, key)
                .min(1 + strsim::damerau_levenshtein(&last(candidate), &last(key)))
        })
        .unwrap_or_default()
}

fn collect_keys(table: &Table, prefix: &str, into: &mut Vec<String>) {
    for (name, value) in table {
        let key = format!("{prefix}{name}");
        if let Value::Table(inner) = value {
            collect_keys(inner, &format!("{key}."), into);
        }
        into.push(key);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SelectorKind;

    fn load(preset: Option<&str>, set: &[&str]) -> Result<Config, ConfigError> {
        Config::load(&Source {
            preset: preset.map(str::to_owned),
            file: None,
            set: set.iter().map(|s| (*s).to_owned()).collect(),
        })
    }

    #[test]
    fn every_preset_loads_and_paper_is_the_default() {
        for (name, _) in PRESETS {
            load(Some(name), &[]).expect(name);
        }
        assert_eq!(load(Some("paper"), &[]).expect("paper"), Config::default());
    }

    #[test]
    fn settings_win_over_the_preset() {
        let config = load(
            Some("paper"),
            &[
                "learner.batch_size=16",
                "env.id=highway/night",
                "loss.reward_scale=3",
            ],
        )
        .expect("valid");
        assert_eq!(config.learner.batch_size, 16);
        assert_eq!(config.env.id, "highway/night");
        assert_eq!(config.loss.reward_scale, 3.0);
    }

    #[test]
    fn an_unknown_key_names_the_nearest() {
        for (given, near) in [
            ("learner.batchsize=3", "learner.batch_size"),
            ("batch_size=3", "learner.batch_size"),
            ("loss.kl_balence=0.5", "loss.kl_balance"),
            ("behaviour.lambda=1", "behavior"),
            ("lerner.batch_size=3", "learner"),
        ] {
            let error = load(None, &[given]).expect_err("unknown").to_string();
            assert!(error.contains(&format!("`{near}`")), "{error}");
        }
    }

    #[test]
    fn wrong_types_and_values_name_the_key() {
        for (given, key) in [
            ("learner.batch_size=\"many\"", "learner.batch_size"),
            ("learner.batch_length=5", "learner.batch_length"),
            ("behavior.start_share=1.5", "behavior.start_share"),
            ("behavior.start_weight=0", "behavior.start_weight"),
            ("behavior.greedy_share=1.1", "behavior.greedy_share"),
            ("model.inverse=magic", "magic"),
            ("env.image_size=128", "env.image_size"),
            ("loss.kl_balance=1.5", "loss.kl_balance"),
            ("loss.gate_share=2", "loss.gate_share"),
            ("optimizer.final_share=0", "optimizer.final_share"),
            ("actor.greedy_share=1.5", "actor.greedy_share"),
            (
                "replay.tables.train.ends_share=-1",
                "replay.tables.train.ends_share",
            ),
            ("actor.threads=0", "actor.threads"),
            ("learner.table=new", "train"),
            ("replay.tables.new=3", "replay.tables.new"),
            (
                "replay.tables.train.newest_share=2",
                "replay.tables.train.newest_share",
            ),
        ] {
            let error = load(None, &[given]).expect_err("invalid").to_string();
            assert!(error.contains(key), "{error}");
        }
    }

    #[test]
    fn a_new_table_begins_with_the_defaults() {
        let config = load(
            None,
            &[
                "replay.tables.new.selector=recent",
                "replay.tables.new.newest=500",
                "learner.table=new",
            ],
        )
        .expect("valid");
        let expected = TableConfig {
            selector: SelectorKind::Recent,
            newest: 500,
            ..TableConfig::default()
        };
        assert_eq!(config.replay.tables["new"], expected);
        assert_eq!(config.replay.tables["train"], TableConfig::default());
        let error = load(None, &["replay.tables.new.newst=500"])
            .expect_err("unknown")
            .to_string();
        assert!(error.contains("newest"), "{error}");
    }

    #[test]
    fn the_resolved_file_resolves_to_itself() {
        let config = load(
            Some("quick"),
            &["seed=7", "replay.tables.new.limited=false"],
        )
        .expect("valid");
        let file = tempfile::NamedTempFile::new().expect("temporary file");
        std::fs::write(file.path(), config.to_toml()).expect("write");
        assert_eq!(Config::from_file(file.path()).expect("valid"), config);
    }

    #[test]
    fn the_paper_makes_about_25_000_updates() {
        assert_eq!(Config::default().total_updates(), 24_600);
    }
}
