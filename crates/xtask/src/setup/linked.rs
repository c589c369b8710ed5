//! A libtorch that the user has: `.native/libtorch` becomes a folder of links to it, so that the rpath of
//! our binaries and plain cargo commands find it as well.

use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

use anyhow::{Context, Result, bail};

use super::libtorch::VERSION;
use super::manifest::Manifest;
use crate::stage::output;

const WHERE_IS_TORCH: &str = "import os, torch; print(os.path.dirname(os.path.abspath(torch.__file__))); print(torch.__version__)";

/// A libtorch outside the repository.
#[derive(Debug)]
pub(super) struct Present {
    /// Holds `include` and `lib`.
    pub(super) path: PathBuf,
    /// For example `2.11.0+cu130`; an unpacked libtorch need not say it.
    version: Option<String>,
}

/// The libtorch that `LIBTORCH_USE_PYTORCH` or `LIBTORCH` ask for, if any, in the order of torch-sys.
pub(super) fn wanted(root: &Path) -> Result<Option<Present>> {
    if env::var_os("LIBTORCH_USE_PYTORCH").is_some() {
        let printed = output(Command::new("python3").args(["-c", WHERE_IS_TORCH])).context(
            "LIBTORCH_USE_PYTORCH is set but python3 cannot import torch: activate the environment that has it, \
             or unset the variable",
        )?;
        let printed = String::from_utf8_lossy(&printed).into_owned();
        let mut lines = printed.lines();
        let path = lines.next().context("python3 printed no path of torch")?;
        return Ok(Some(Present {
            path: path.into(),
            version: lines.next().map(str::to_owned),
        }));
    }
    let Some(path) = env::var_os("LIBTORCH").map(PathBuf::from) else {
        return Ok(None);
    };
    if is_ours(&path, root) {
        return Ok(None);
    }
    let version = fs::read_to_string(path.join("build-version")).ok();
    let path = fs::canonicalize(&path)
        .with_context(|| format!("LIBTORCH is {}: correct or unset it", path.display()))?;
    Ok(Some(Present {
        path,
        version: version.map(|text| text.trim().to_owned()),
    }))
}

/// `.cargo/config.toml` sets `LIBTORCH` for us too, also before the folder exists.
fn is_ours(path: &Path, root: &Path) -> bool {
    let base = path
        .ancestors()
        .nth(2)
        .and_then(|base| fs::canonicalize(base).ok());
    path.ends_with(".native/libtorch") && base.as_deref() == Some(root)
}

/// Fills `made` with links to what `present` has.
pub(super) fn make(present: &Present, made: &Path) -> Result<Manifest> {
    let path = &present.path;
    if let Some(version) = &present.version
        && version.split('+').next() != Some(VERSION)
        && env::var_os("LIBTORCH_BYPASS_VERSION_CHECK").is_none()
    {
        bail!(
            "the libtorch in {} is {version}, this needs {VERSION}: unset LIBTORCH and LIBTORCH_USE_PYTORCH to have \
             it fetched, or set LIBTORCH_BYPASS_VERSION_CHECK",
            path.display()
        );
    }
    if let Some(missing) = missing(path) {
        bail!(
            "{} is not a libtorch, it has no {missing}: correct LIBTORCH, or unset it to have one fetched",
            path.display()
        );
    }
    for name in ["include", "lib"] {
        symlink(path.join(name), made.join(name))
            .with_context(|| format!("cannot link {}", made.join(name).display()))?;
    }
    if let Some(version) = &present.version {
        fs::write(made.join("build-version"), format!("{version}\n"))?;
    }
    Ok(Manifest::of_link(path))
}

/// The first thing that a libtorch has and `path` has not.
pub(super) fn missing(path: &Path) -> Option<&'static str> {
    let library = if cfg!(target_os = "macos") {
        "lib/libtorch.dylib"
    } else {
        "lib/libtorch.so"
    };
    ["include/torch/csrc/api/include/torch/torch.h", library]
        .into_iter()
        .find(|name| !path.join(name).is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_variable_that_cargo_sets_is_not_the_users() {
        let root = fs::canonicalize(env!("CARGO_MANIFEST_DIR")).unwrap();
        assert!(is_ours(&root.join(".native/libtorch"), &root));
        assert!(!is_ours(Path::new("/opt/libtorch"), &root));
        assert!(!is_ours(&root.join("src/.native/libtorch"), &root));
    }
}
