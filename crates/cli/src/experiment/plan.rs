//! The runs of an experiment.

use std::path::{Path, PathBuf};

use super::definition::{Definition, Scale, Variant};

/// All runs, seed after seed, so that a comparison is whole before the next seed begins.
#[derive(Debug)]
pub(super) struct Plan {
    pub(super) runs: Vec<Run>,
}

/// One method on one task with one seed.
#[derive(Debug, Clone)]
pub(super) struct Run {
    pub(super) task: String,
    pub(super) method: String,
    pub(super) seed: u64,
    pub(super) preset: String,
    /// Settings over the preset.
    pub(super) set: Vec<String>,
    pub(super) episodes: u64,
    pub(super) tests: Vec<Variant>,
    /// Its run directory.
    pub(super) dir: PathBuf,
}

impl Plan {
    pub(super) fn new(
        definition: &Definition,
        scale: Scale,
        folder: &Path,
    ) -> anyhow::Result<Self> {
        let size = definition.size(scale)?;
        let mut runs = Vec::new();
        for seed in 0..size.seeds {
            for task in &definition.tasks {
                for method in &definition.methods {
                    let mut set = [&size.set[..], &task.set, &method.set].concat();
                    set.push(format!("seed={seed}"));
                    let named = |variant: &Variant| Variant {
                        set: named(&variant.set, &task.name),
                        ..variant.clone()
                    };
                    runs.push(Run {
                        task: task.name.clone(),
                        method: method.name.clone(),
                        seed,
                        preset: size.preset.clone(),
                        set: self::named(&set, &task.name),
                        episodes: size.episodes,
                        tests: definition.tests.iter().map(named).collect(),
                        dir: folder
                            .join(&task.name)
                            .join(&method.name)
                            .join(format!("seed-{seed}")),
                    });
                }
            }
        }
        Ok(Self { runs })
    }
}

impl Run {
    /// For people.
    pub(super) fn name(&self) -> String {
        let task = if self.task.is_empty() { "" } else { "/" };
        format!("{}{task}{}/seed-{}", self.task, self.method, self.seed)
    }

    /// What the final comparison writes last: a run that has it was trained.
    pub(super) fn evaluation(&self) -> PathBuf {
        self.dir.join("evaluation.json")
    }

    pub(super) fn test(&self, test: &Variant) -> PathBuf {
        self.dir.join(format!("evaluation-{}.json", test.name))
    }
}

/// Settings with the task's name in its place.
fn named(set: &[String], task: &str) -> Vec<String> {
    set.iter()
        .map(|text| text.replace("{task}", task))
        .collect()
}
