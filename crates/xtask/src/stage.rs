//! Stages: commands that are timed, named and stop everything when they fail.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;
use std::{env, fs};

use anyhow::{Context, Result, bail};

/// The folder that holds the workspace, wherever in it `cargo xtask` was typed.
pub(crate) fn repository_root() -> Result<PathBuf> {
    let manifest_dir = env::var_os("CARGO_MANIFEST_DIR")
        .context("CARGO_MANIFEST_DIR is not set: start this as `cargo xtask`")?;
    let root = Path::new(&manifest_dir).join("../..");
    fs::canonicalize(&root).with_context(|| format!("cannot find {}", root.display()))
}

/// Runs `work` as the stage `name` and says how long it took.
pub(crate) fn stage<T>(name: &str, work: impl FnOnce() -> Result<T>) -> Result<T> {
    let start = Instant::now();
    let result = work();
    let outcome = if result.is_ok() { "ok" } else { "FAILED" };
    eprintln!(
        "xtask: {name}: {outcome} in {:.1} s",
        start.elapsed().as_secs_f64()
    );
    result.with_context(|| format!("stage `{name}` failed"))
}

/// Cargo, the same that started us, in `root` and with the native libraries where the dynamic loader finds them: the
/// rpath of our binaries does not cover doc tests and target folders elsewhere.
pub(crate) fn cargo<'a>(root: &Path, args: impl IntoIterator<Item = &'a str>) -> Command {
    let program = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(program);
    command.current_dir(root).args(args);
    with_native(&mut command, root);
    command
}

/// Puts libtorch and MuJoCo on the search path of the dynamic loader.
pub(crate) fn with_native(command: &mut Command, root: &Path) {
    let variable = if cfg!(target_os = "macos") {
        "DYLD_FALLBACK_LIBRARY_PATH"
    } else {
        "LD_LIBRARY_PATH"
    };
    let mut path = root.join(".native/libtorch/lib").into_os_string();
    path.push(":");
    path.push(root.join(".native/mujoco/lib"));
    if let Some(present) = env::var_os(variable).filter(|value| !value.is_empty()) {
        path.push(":");
        path.push(present);
    }
    command.env(variable, path);
}

/// Runs `command` with our output, and fails where it fails.
pub(crate) fn run(command: &mut Command) -> Result<()> {
    let status = command
        .status()
        .with_context(|| format!("cannot start {}", program(command)))?;
    if !status.success() {
        bail!("{} ended with {status}", line(command));
    }
    Ok(())
}

/// Runs `command` and returns what it printed on stdout; its stderr is ours.
pub(crate) fn output(command: &mut Command) -> Result<Vec<u8>> {
    let output = command
        .stderr(Stdio::inherit())
        .output()
        .with_context(|| format!("cannot start {}", program(command)))?;
    if !output.status.success() {
        bail!("{} ended with {}", line(command), output.status);
    }
    Ok(output.stdout)
}

/// Whether `program args` runs at all, which is how one asks whether a tool is installed.
pub(crate) fn answers(command: &mut Command) -> bool {
    command
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success())
}

fn program(command: &Command) -> String {
    command.get_program().to_string_lossy().into_owned()
}

/// The command as one would type it.
pub(crate) fn line(command: &Command) -> String {
    let name = Path::new(command.get_program())
        .file_name()
        .unwrap_or(command.get_program());
    let mut line = name.to_string_lossy().into_owned();
    for arg in command.get_args() {
        line.push(' ');
        line.push_str(&arg.to_string_lossy());
    }
    line
}
