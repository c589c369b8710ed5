//! `cargo xtask deploy kubernetes`: renders what lies in `deploy/k8s` and holds it against the schemas of Kubernetes,
//! against itself and against isodream. No cluster is needed, and none has been asked.

mod addresses;
mod autoscaling;
mod commands;
mod files;
mod hardening;
mod network;
mod objects;
mod references;
mod storage;
#[cfg(test)]
mod tests;
mod tools;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

use self::commands::Isodream;
use self::objects::Objects;
use self::tools::Tools;

/// Where the manifests are.
const MANIFESTS: &str = "deploy/k8s";
/// Where in [`MANIFESTS`] the folders are that one builds.
const OVERLAYS: &str = "overlays";
/// The files that secrets are made of.
const SECRETS: &[&str] = &[
    "ca.pem",
    "server.pem",
    "server.key",
    "client.pem",
    "client.key",
    "tokens",
    "learner.token",
    "actor.token",
];

/// Options of `cargo xtask deploy kubernetes`.
#[derive(Debug, clap::Args)]
pub(crate) struct KubernetesArgs {
    /// A binary that is asked whether it takes the arguments, variables, settings and probes of every container, as
    /// `cargo xtask test` does
    #[arg(long, value_name = "FILE")]
    isodream: Option<PathBuf>,
}

/// Checks everything that can be checked with what `args` gives.
pub(crate) fn kubernetes(root: &Path, args: &KubernetesArgs) -> Result<()> {
    check(root, args.isodream.as_deref())
}

/// Renders base and overlays and fails with all problems that there are. Without `isodream` the commands of the
/// containers are not checked.
pub(crate) fn check(root: &Path, isodream: Option<&Path>) -> Result<()> {
    let manifests = Manifests::stage(root)?;
    let mut problems = manifests.base()?;
    for overlay in manifests.overlays()? {
        let validated = manifests.overlay(&overlay)?;
        let objects = Objects(&validated.objects);
        let mut found = validated.problems;
        found.extend(manifests.problems(objects));
        if let Some(path) = isodream {
            let work = tempfile::tempdir()?;
            found.extend(Isodream { path, root }.refuses(objects, work.path())?);
        }
        ensure!(!objects.0.is_empty(), "{overlay}: no objects");
        eprintln!("xtask: {overlay}: {} objects", objects.0.len());
        problems.extend(found.iter().map(|problem| format!("{overlay}: {problem}")));
    }
    if let Some(path) = isodream {
        problems.extend(Isodream { path, root }.makes_no(SECRETS)?);
    } else {
        eprintln!("xtask: commands of containers are not checked without --isodream");
    }
    if !problems.is_empty() {
        bail!("{}", problems.join("\n"));
    }
    Ok(())
}

/// A copy of the manifests with secrets of nobody.
struct Manifests {
    folder: tempfile::TempDir,
    tools: Tools,
    rules: Value,
    exported: Vec<String>,
}

impl Manifests {
    fn stage(root: &Path) -> Result<Self> {
        let tools = Tools::ensure(root)?;
        let folder = tempfile::tempdir()?;
        copy(&root.join(MANIFESTS), folder.path())?;
        for name in SECRETS {
            fs::write(folder.path().join("secrets").join(name), "thrown away\n")?;
        }
        let rules = fs::read(folder.path().join(autoscaling::RULES))
            .with_context(|| format!("cannot read {}", autoscaling::RULES))?;
        let rules = tools.parse(&rules)?.pop().unwrap_or_default();
        Ok(Self {
            folder,
            tools,
            rules,
            exported: autoscaling::exported(root)?,
        })
    }

    /// What schemas refuse of the base, which has no secrets and sizes of its own.
    fn base(&self) -> Result<Vec<String>> {
        let rendered = self.tools.render(&self.folder.path().join("base"))?;
        let problems = self.tools.validate(&rendered)?.problems;
        Ok(problems
            .iter()
            .map(|problem| format!("base: {problem}"))
            .collect())
    }

    /// The names of all overlays.
    fn overlays(&self) -> Result<Vec<String>> {
        let folder = self.folder.path().join(OVERLAYS);
        let mut names = Vec::new();
        for entry in fs::read_dir(&folder).context("there are no overlays")? {
            names.push(entry?.file_name().to_string_lossy().into_owned());
        }
        names.sort();
        Ok(names)
    }

    fn overlay(&self, name: &str) -> Result<tools::Validated> {
        let folder = self.folder.path().join(OVERLAYS).join(name);
        self.tools.validate(&self.tools.render(&folder)?)
    }

    /// What is wrong with objects that schemas do not refuse.
    fn problems(&self, objects: Objects<'_>) -> Vec<String> {
        let mut found = references::problems(objects);
        let flows = addresses::flows(objects, &mut found);
        found.extend(network::problems(objects, &flows));
        found.extend(addresses::listening(objects));
        found.extend(files::problems(objects));
        found.extend(hardening::problems(objects));
        found.extend(storage::problems(objects));
        found.extend(autoscaling::problems(objects, &self.rules, &self.exported));
        found
    }
}

/// Copies what git would have: no secrets of somebody who uses this working tree.
fn copy(from: &Path, to: &Path) -> Result<()> {
    for entry in fs::read_dir(from).with_context(|| format!("cannot list {}", from.display()))? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            fs::create_dir(&target)?;
            copy(&entry.path(), &target)?;
        } else if !from.ends_with("secrets") || entry.file_name() == "kustomization.yaml" {
            fs::copy(entry.path(), &target)?;
        }
    }
    Ok(())
}
