//! The two release binaries: with libtorch for actor and learner, without for the replay-server.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use clap::Args;

use crate::run::{release_binary, target_dir};
use crate::stage::{cargo, run, stage};

/// Binaries that need not be built.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct Binaries {
    /// Use this binary in the images of actor and learner instead of building one.
    #[arg(long, value_name = "FILE")]
    binary: Option<PathBuf>,
    /// Use this binary in the image of the replay-server instead of building one.
    #[arg(long, value_name = "FILE")]
    torch_free_binary: Option<PathBuf>,
}

impl Binaries {
    /// The binary with or without libtorch, built unless one was given.
    pub(super) fn find(&self, root: &Path, needs_torch: bool) -> Result<PathBuf> {
        let given = if needs_torch {
            &self.binary
        } else {
            &self.torch_free_binary
        };
        match given {
            Some(path) => {
                ensure!(path.is_file(), "no such file: {}", path.display());
                Ok(path.clone())
            }
            None if needs_torch => release_binary(root),
            None => torch_free_binary(root),
        }
    }
}

/// Builds the binary without libtorch, and leaves the one with it where it was: cargo gives both the same path.
fn torch_free_binary(root: &Path) -> Result<PathBuf> {
    let folder = target_dir(root)?.join("release");
    let path = folder.join("isodream");
    let (aside, made) = (
        folder.join("isodream-with-torch"),
        folder.join("isodream-torch-free"),
    );
    let renamed = |from: &Path, to: &Path| {
        fs::rename(from, to).with_context(|| format!("cannot create {}", to.display()))
    };
    let present = path.is_file();
    if present {
        renamed(&path, &aside)?;
    }
    let built = stage("build without libtorch", || {
        let args = ["build", "--release", "--locked", "--no-default-features"];
        let which = ["--package", "isodream", "--features", "opentelemetry"];
        run(cargo(root, args).args(which))?;
        renamed(&path, &made)
    });
    if present {
        renamed(&aside, &path)?;
    }
    built.map(|()| made)
}
