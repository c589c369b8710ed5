//! `cargo xtask setup`: makes `.native/libtorch` and `.native/mujoco`, and leaves each alone where it stands.

mod libtorch;
mod linked;
mod manifest;
mod mujoco;
mod preflight;
mod wheels;

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::process;

use anyhow::{Context, Result};

use self::manifest::Manifest;
use crate::stage::stage;

/// Folders of this name are work in progress, or what a killed setup left of it.
const WORK_PREFIX: &str = "tmp-";

/// Makes `.native` complete; with `verify` every file is hashed, not only measured.
pub(crate) fn ensure(root: &Path, verify: bool) -> Result<()> {
    let native = root.join(".native");
    fs::create_dir_all(&native).with_context(|| format!("cannot create {}", native.display()))?;
    let _lock = lock(&native)?;
    remove_leftovers(&native)?;
    libtorch::ensure(root, &native, verify)?;
    mujoco::ensure(&native, verify)
}

/// What `mismatch` says about the folder `name`; a stage of its own where it hashes.
fn checked(
    name: &str,
    verify: bool,
    mismatch: impl FnOnce() -> Option<String>,
) -> Result<Option<String>> {
    if verify {
        stage(&format!("verify {name}"), || Ok(mismatch()))
    } else {
        Ok(mismatch())
    }
}

/// Puts what `make` makes of a work folder and an empty one in the place of `.native/{name}`.
fn install(
    native: &Path,
    name: &str,
    manifest: &str,
    reason: &str,
    make: impl FnOnce(&Path, &Path) -> Result<Manifest>,
) -> Result<()> {
    let target = native.join(name);
    eprintln!("xtask: making {}: {reason}", target.display());
    let work = native.join(format!("{WORK_PREFIX}{}", process::id()));
    let made = work.join(name);
    fs::create_dir_all(&made).with_context(|| format!("cannot create {}", made.display()))?;
    let contents = make(&work, &made)?;
    replace(&target, &made, &work)?;
    contents.write(native, manifest)?;
    remove_leftovers(native)
}

/// One setup at a time: a second one waits, and then finds everything in place.
fn lock(native: &Path) -> Result<File> {
    let path = native.join(".lock");
    let file = File::create(&path).with_context(|| format!("cannot create {}", path.display()))?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            eprintln!("xtask: waiting for another setup to end");
            file.lock()
                .with_context(|| format!("cannot lock {}", path.display()))?;
        }
        Err(TryLockError::Error(error)) => {
            return Err(error).with_context(|| format!("cannot lock {}", path.display()));
        }
    }
    Ok(file)
}

/// Under the lock nobody else can be working in these folders.
fn remove_leftovers(native: &Path) -> Result<()> {
    for entry in fs::read_dir(native)? {
        let entry = entry?;
        if entry.file_name().to_string_lossy().starts_with(WORK_PREFIX) {
            fs::remove_dir_all(entry.path())
                .with_context(|| format!("cannot remove {}", entry.path().display()))?;
        }
    }
    Ok(())
}

/// Puts `made` in the place of `target`; what was there goes to the work folder, which is removed last.
fn replace(target: &Path, made: &Path, work: &Path) -> Result<()> {
    let old: PathBuf = work.join("old");
    if target.symlink_metadata().is_ok() {
        fs::rename(target, &old)
            .with_context(|| format!("cannot move {} away", target.display()))?;
    }
    fs::rename(made, target).with_context(|| format!("cannot create {}", target.display()))
}
