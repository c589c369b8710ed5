//! `cargo xtask setup`: makes `.native/libtorch/{include,lib,build-version}` and leaves it alone where it
//! stands.

mod linked;
mod manifest;
mod preflight;
mod wheels;

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::process;

use anyhow::{Context, Result};

use self::manifest::Manifest;
use crate::stage::stage;

/// The libtorch that tch builds against.
const VERSION: &str = "2.11.0";
/// Folders of this name are work in progress, or what a killed setup left of it.
const WORK_PREFIX: &str = "tmp-";

/// Makes `.native` complete; with `verify` every file is hashed, not only measured.
pub(crate) fn ensure(root: &Path, verify: bool) -> Result<()> {
    let native = root.join(".native");
    fs::create_dir_all(&native).with_context(|| format!("cannot create {}", native.display()))?;
    let _lock = lock(&native)?;
    remove_leftovers(&native)?;

    let libtorch = native.join("libtorch");
    let wanted = linked::wanted(root)?;
    let reason = match Manifest::read(&native) {
        Some(manifest)
            if wanted.is_some()
                && manifest.linked() != wanted.as_ref().map(|w| w.path.as_path()) =>
        {
            "another libtorch is asked for by the environment".to_owned()
        }
        Some(manifest) if verify => {
            match stage("verify libtorch", || Ok(manifest.mismatch(&libtorch, true)))? {
                None => return Ok(()),
                Some(reason) => reason,
            }
        }
        Some(manifest) => match manifest.mismatch(&libtorch, false) {
            None => return Ok(()),
            Some(reason) => reason,
        },
        None if wanted.is_none() && wheels::is_complete(&libtorch) => {
            preflight::compiler()?;
            return stage("adopt the libtorch that is there", || {
                Manifest::of_files(&libtorch, &[])?.write(&native)
            });
        }
        None => "it is not complete".to_owned(),
    };
    eprintln!("xtask: making {}: {reason}", libtorch.display());
    preflight::compiler()?;

    let work = native.join(format!("{WORK_PREFIX}{}", process::id()));
    let made = work.join("libtorch");
    fs::create_dir_all(&made).with_context(|| format!("cannot create {}", made.display()))?;
    let manifest = match &wanted {
        Some(present) => linked::make(present, &made)?,
        None => wheels::make(&work, &made)?,
    };
    replace(&libtorch, &made, &work)?;
    manifest.write(&native)?;
    remove_leftovers(&native)
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
