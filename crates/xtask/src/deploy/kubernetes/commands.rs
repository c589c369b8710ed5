//! Whether isodream takes what the containers give it: arguments, environment, configuration, and secrets that it made.

use std::fs;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result};

use super::objects::{Objects, Workload, list, text, title};
use crate::stage::with_native;

/// A value that is refused after all others have been found good: a role stops at it with its arguments and its
/// configuration taken, and nothing done.
const REFUSED: &str = "learner.keep_checkpoints=0";
/// What a role says to that.
const REFUSAL: &str = "learner.keep_checkpoints: must be at least 2";
/// Where the roles find the configuration.
const CONFIG: &str = "--config=/etc/isodream/config/run.toml";

/// An isodream to ask.
#[derive(Debug, Clone, Copy)]
pub(super) struct Isodream<'a> {
    /// The program.
    pub(super) path: &'a Path,
    /// The repository, for the native libraries.
    pub(super) root: &'a Path,
}

impl Isodream<'_> {
    /// What it prints when it is started with `args`.
    fn says<A: AsRef<std::ffi::OsStr>>(self, args: impl IntoIterator<Item = A>) -> Result<String> {
        let mut command = Command::new(self.path);
        with_native(command.args(args), self.root);
        let output = command
            .output()
            .with_context(|| format!("cannot start {}", self.path.display()))?;
        let printed = [output.stdout, output.stderr].concat();
        Ok(String::from_utf8_lossy(&printed).into_owned())
    }

    /// The first of the files `wanted` that `isodream secrets` does not make, with what it says.
    pub(super) fn makes_no(self, wanted: &[&str]) -> Result<Option<String>> {
        let work = tempfile::tempdir()?;
        let folder = work.path().join("secrets");
        let path = folder.display().to_string();
        let args = ["secrets", &path, "--host", "localhost"].map(str::to_owned);
        let said = self.says(&args)?;
        let missing = wanted.iter().find(|name| !folder.join(name).is_file());
        Ok(missing.map(|name| format!("no {name} after {}", complaint(&args, &said))))
    }

    /// Arguments, variables, settings and probes that it does not take. `work` is an empty folder.
    pub(super) fn refuses(self, objects: Objects<'_>, work: &Path) -> Result<Vec<String>> {
        let mut found = Vec::new();
        for workload in objects.workloads() {
            for refusal in [
                self.arguments(workload, objects, work)?,
                self.variables(workload)?,
                self.probe(workload)?,
            ] {
                found.extend(refusal.map(|refusal| format!("{}: {refusal}", title(workload.0))));
            }
        }
        Ok(found)
    }

    fn arguments(
        self,
        workload: Workload<'_>,
        objects: Objects<'_>,
        work: &Path,
    ) -> Result<Option<String>> {
        let map = objects
            .of_kind("ConfigMap")
            .next()
            .context("there is no ConfigMap")?;
        let config = work.join("run.toml");
        fs::write(&config, text(&map["data"]["run.toml"]))
            .with_context(|| format!("cannot write {}", config.display()))?;
        let mut args = workload.args(objects);
        for arg in args.iter_mut().filter(|arg| *arg == CONFIG) {
            *arg = format!("--config={}", config.display());
        }
        args.extend(["--set".to_owned(), REFUSED.to_owned()]);
        let said = self.says(&args)?;
        Ok((!said.contains(REFUSAL)).then(|| complaint(&args, &said)))
    }

    /// The first variable of the container's environment that the role does not know.
    fn variables(self, workload: Workload<'_>) -> Result<Option<String>> {
        let container = workload.container();
        let role = text(&container["args"][0]);
        let help = self.says([role, "--help"])?;
        Ok(list(&container["env"])
            .iter()
            .map(|variable| text(&variable["name"]))
            .find(|name| name.starts_with("ISODREAM_") && !help.contains(&format!("[env: {name}=")))
            .map(|name| format!("isodream {role} does not know {name}")))
    }

    /// The probe's command with a call for help, which is answered where the rest is understood.
    fn probe(self, workload: Workload<'_>) -> Result<Option<String>> {
        let command = list(&workload.container()["startupProbe"]["exec"]["command"]);
        let Some((_, args)) = command.split_first() else {
            return Ok(None);
        };
        let args = args.iter().map(text).chain(["--help"]);
        let args: Vec<String> = args.map(str::to_owned).collect();
        let said = self.says(&args)?;
        Ok((!said.contains("--tls-ca")).then(|| complaint(&args, &said)))
    }
}

/// A command and what it said, up to the usage that the parser adds.
fn complaint(args: &[String], said: &str) -> String {
    let said = said.trim().split("\n\n").next().unwrap_or_default();
    format!("isodream {}: {said}", args.join(" "))
}
