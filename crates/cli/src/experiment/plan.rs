//! The runs of an experiment.

use std::path::{Path, PathBuf};

use anyhow::ensure;
use isodream_core::Config;
use isodream_core::config::Source;

use super::definition::{Definition, Scale, Variant};
use super::evaluation::Evaluation;

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
    /// What the run that it begins with writes last.
    pub(super) source: Option<PathBuf>,
}

/// The method whose runs others may begin with.
const SOURCE: &str = "source";

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
                    let dir = |method: &str| {
                        let dir = folder.join(&task.name).join(method);
                        dir.join(format!("seed-{seed}"))
                    };
                    let mut set = [&size.set[..], &task.set, &method.set].concat();
                    set.push(format!("seed={seed}"));
                    let needs_source = set.iter().any(|setting| setting.contains("{source}"));
                    let source = dir(SOURCE).display().to_string();
                    let named = |set: &[String]| -> Vec<String> {
                        set.iter()
                            .map(|text| text.replace("{task}", &task.name))
                            .map(|text| text.replace("{source}", &source))
                            .collect()
                    };
                    let test = |test: &Variant| Variant {
                        set: named(&test.set),
                        ..test.clone()
                    };
                    runs.push(Run {
                        task: task.name.clone(),
                        method: method.name.clone(),
                        seed,
                        preset: size.preset.clone(),
                        set: named(&set),
                        episodes: size.episodes,
                        tests: definition.tests.iter().map(test).collect(),
                        dir: dir(&method.name),
                        source: needs_source.then(|| evaluation(&dir(SOURCE))),
                    });
                }
            }
        }
        Ok(Self { runs })
    }

    /// The runs that were made.
    ///
    /// # Errors
    /// Of [`Run::is_made`].
    pub(super) fn made(&self) -> anyhow::Result<Vec<&Run>> {
        let mut made = Vec::new();
        for run in &self.runs {
            if run.is_made()? {
                made.push(run);
            }
        }
        Ok(made)
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
        evaluation(&self.dir)
    }

    /// Whether it was trained and evaluated, as the experiment has it now.
    ///
    /// # Errors
    /// Where it was made with other settings or another number of episodes, or what it left is damaged.
    pub(super) fn is_made(&self) -> anyhow::Result<bool> {
        if !self.evaluation().exists() {
            return Ok(false);
        }
        let evaluation = Evaluation::read(&self.evaluation())?;
        let mut made = Config::from_file(&self.dir.join("config.toml"))?;
        let mut wanted = Config::load(&Source {
            preset: Some(self.preset.clone()),
            file: None,
            set: self.set.clone(),
        })?;
        // A source lies wherever the experiment does.
        made.learner.initial.clear();
        wanted.learner.initial.clear();
        ensure!(
            made == wanted && evaluation.episodes == self.episodes,
            "{} was made with other settings than the experiment has now; move the folder away, or choose another --out",
            self.dir.display()
        );
        Ok(true)
    }

    /// Whether what it begins with is there.
    pub(super) fn can_begin(&self) -> bool {
        self.source.as_ref().is_none_or(|source| source.exists())
    }

    pub(super) fn test(&self, test: &Variant) -> PathBuf {
        self.dir.join(format!("evaluation-{}.json", test.name))
    }
}

fn evaluation(dir: &Path) -> PathBuf {
    dir.join("evaluation.json")
}
