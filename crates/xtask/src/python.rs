//! The package in `python/`: its checks and tests, in an environment with the environments that it is tried on.

use std::fs;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result};

use crate::stage::{run, stage, with_native};
use crate::venv::Venv;

/// Where the package is.
const PACKAGE: &str = "python";
/// What its checks and tests need beside it.
const REQUIREMENTS: &str = "tests/requirements.txt";

/// Lints, formatting and types.
pub(crate) fn check(root: &Path) -> Result<()> {
    let venv = environment(root)?;
    let tool = |name: &str, args: &[&str]| {
        let mut command = Command::new(venv.program(name));
        run(command.current_dir(root.join(PACKAGE)).args(args))
    };
    stage("Python: ruff", || {
        tool("ruff", &["check", "--quiet"])?;
        tool("ruff", &["format", "--quiet", "--diff"])
    })?;
    stage("Python: mypy", || tool("mypy", &["--no-error-summary"]))
}

/// All tests, with the binary `isodream` on the other side.
pub(crate) fn test(root: &Path, isodream: &Path) -> Result<()> {
    let venv = environment(root)?;
    let mut command = Command::new(venv.program("pytest"));
    command
        .current_dir(root.join(PACKAGE))
        .arg("--quiet")
        .env("ISODREAM", isodream);
    with_native(&mut command, root);
    stage("Python: tests", || run(&mut command))
}

/// The package, as its source is, with what it is tested with.
fn environment(root: &Path) -> Result<Venv> {
    let package = root.join(PACKAGE);
    let read = |name: &str| {
        let path = package.join(name);
        fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))
    };
    let requirements = package.join(REQUIREMENTS);
    let wanted = read(REQUIREMENTS)? + &read("pyproject.toml")?;
    let title = "install Gymnasium and dm_control";
    Venv::ensure(root, "python", &wanted, title, |venv| {
        let mut pip = venv.pip();
        pip.arg("--requirement").arg(&requirements);
        run(pip.arg("--editable").arg(&package))
    })
}
