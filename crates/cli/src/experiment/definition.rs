//! What an experiment is.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use clap::ValueEnum;
use serde::Deserialize;

/// The files in `experiments/`, in the order of the paper.
const FILES: &[(&str, &str)] = &[
    (
        "driving",
        include_str!("../../../../experiments/driving.toml"),
    ),
    (
        "driving-ablations",
        include_str!("../../../../experiments/driving-ablations.toml"),
    ),
    (
        "rollout-window",
        include_str!("../../../../experiments/rollout-window.toml"),
    ),
    ("dmc", include_str!("../../../../experiments/dmc.toml")),
    (
        "dmc-variance",
        include_str!("../../../../experiments/dmc-variance.toml"),
    ),
    (
        "dmc-generalization",
        include_str!("../../../../experiments/dmc-generalization.toml"),
    ),
    (
        "transfer-noncontrollable",
        include_str!("../../../../experiments/transfer-noncontrollable.toml"),
    ),
    (
        "transfer-controllable",
        include_str!("../../../../experiments/transfer-controllable.toml"),
    ),
];

/// How large an experiment is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Scale {
    /// Seconds, to see that all of it runs
    Smoke,
    /// Hours on a CPU
    Cpu,
    /// As in the paper
    Paper,
}

impl Scale {
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Smoke => "smoke",
            Self::Cpu => "cpu",
            Self::Paper => "paper",
        }
    }
}

/// An experiment.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Definition {
    pub(super) title: String,
    /// The place in the paper.
    pub(super) source: String,
    pub(super) about: String,
    /// The metric whose curve is drawn.
    #[serde(default = "returns")]
    pub(super) metric: String,
    pub(super) scale: BTreeMap<Scale, Size>,
    #[serde(rename = "method")]
    pub(super) methods: Vec<Method>,
    /// What each method is trained on; one without a name where there is only one.
    #[serde(rename = "task", default = "only_task")]
    pub(super) tasks: Vec<Variant>,
    /// Where trained policies are evaluated as well.
    #[serde(rename = "test", default)]
    pub(super) tests: Vec<Variant>,
}

/// An experiment at one scale.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Size {
    pub(super) preset: String,
    pub(super) seeds: u64,
    /// Episodes of each evaluation.
    pub(super) episodes: u64,
    #[serde(default)]
    pub(super) set: Vec<String>,
}

/// What is compared.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Method {
    pub(super) name: String,
    pub(super) label: String,
    /// `{source}` stands for the run directory of the method of that name, which is trained before.
    #[serde(default)]
    pub(super) set: Vec<String>,
    /// The paper's words or numbers: by task, `return` where there is only one, `TEST/TASK` for tests.
    #[serde(default)]
    pub(super) reported: BTreeMap<String, String>,
}

/// A task or a test: settings, in which `{task}` stands for the task's name.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Variant {
    pub(super) name: String,
    pub(super) label: String,
    #[serde(default)]
    pub(super) set: Vec<String>,
}

fn returns() -> String {
    "eval/score".to_owned()
}

fn only_task() -> Vec<Variant> {
    vec![Variant::default()]
}

impl Definition {
    fn parse(origin: &str, text: &str) -> anyhow::Result<Self> {
        let definition: Self =
            toml::from_str(text).with_context(|| format!("experiment {origin}"))?;
        ensure!(
            !definition.methods.is_empty(),
            "experiment {origin} compares nothing: it needs a [[method]]"
        );
        Ok(definition)
    }

    pub(super) fn size(&self, scale: Scale) -> anyhow::Result<&Size> {
        let known = || self.scale.keys().map(|scale| scale.as_str());
        self.scale.get(&scale).with_context(|| {
            let known: Vec<_> = known().collect();
            format!(
                "it has no scale {}, only {}",
                scale.as_str(),
                known.join(", ")
            )
        })
    }
}

/// All experiments by name.
pub(super) fn all() -> anyhow::Result<Vec<(&'static str, Definition)>> {
    FILES
        .iter()
        .map(|&(name, text)| Ok((name, Definition::parse(name, text)?)))
        .collect()
}

/// The experiment of this name, or in this file, and the name of its folder.
pub(super) fn find(name: &str) -> anyhow::Result<(String, Definition)> {
    if let Some((known, text)) = FILES.iter().find(|(known, _)| *known == name) {
        return Ok(((*known).to_owned(), Definition::parse(name, text)?));
    }
    let path = Path::new(name);
    if !path.is_file() {
        let known: Vec<_> = FILES.iter().map(|(known, _)| *known).collect();
        bail!(
            "there is no experiment and no file {name}; known: {}",
            known.join(", ")
        );
    }
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {name}"))?;
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    Ok((stem.into_owned(), Definition::parse(name, &text)?))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use isodream_core::Config;
    use isodream_core::config::Source;

    use super::super::plan::Plan;
    use super::*;

    #[test]
    fn every_run_of_every_experiment_has_a_valid_configuration() {
        for (name, definition) in all().unwrap() {
            for &scale in definition.scale.keys() {
                let plan = Plan::new(&definition, scale, Path::new("runs")).unwrap();
                assert!(!plan.runs.is_empty());
                for run in &plan.runs {
                    let config = Config::load(&Source {
                        preset: Some(run.preset.clone()),
                        file: None,
                        set: run.set.clone(),
                    })
                    .unwrap_or_else(|error| panic!("{name} {scale:?} {}: {error}", run.name()));
                    isodream_envs::spec(&config.env).unwrap();
                    assert_eq!(config.seed, run.seed);
                    for test in &run.tests {
                        let config = config.with(&test.set).unwrap();
                        isodream_envs::spec(&config.env).unwrap();
                    }
                }
            }
            // What the paper reports is of things that are run.
            for key in definition
                .methods
                .iter()
                .flat_map(|method| method.reported.keys())
            {
                let (test, task) = key
                    .split_once('/')
                    .map_or((None, &**key), |(a, b)| (Some(a), b));
                let tasks = definition.tasks.iter().any(|known| known.name == task);
                assert!(tasks || task == "return", "{name}: {key}");
                let tests =
                    test.is_none_or(|test| definition.tests.iter().any(|known| known.name == test));
                assert!(tests, "{name}: {key}");
            }
        }
    }
}
