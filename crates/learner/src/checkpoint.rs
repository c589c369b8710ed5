//! Checkpoints: a folder per checkpoint with one manifest that ties its files together.
//!
//! `checkpoints/00001200/` holds
//! - `model.safetensors`: every parameter, `F32`, named by its place (`world_model.encoder.stem.conv0.weight`),
//!   linear weights `[out, in]`, convolutions `[out, in, k, k]`, transposed ones `[in, out, k, k]`, as in PyTorch
//! - `optimizer.safetensors`: Adam's moments `<group>.first` and `<group>.second`, flat in the order of the group
//! - `config.toml`: the resolved configuration
//! - `manifest.json`: counters, and size and SHA-256 of every file; written last
//!
//! The folder is written under a temporary name, synced and renamed, so that a folder with a number is whole
//! unless the disk damaged it. Loading checks the hashes and walks back to the newest valid one. Random numbers
//! need no state: every update draws from a seed derived from its own number.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use isodream_core::Config;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

const FORMAT: u32 = 1;
const MODEL: &str = "model.safetensors";
const OPTIMIZER: &str = "optimizer.safetensors";
const CONFIG: &str = "config.toml";
const MANIFEST: &str = "manifest.json";

/// Where a run stands.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counters {
    /// Training steps made; also the version of the policy.
    pub updates: u64,
    /// Steps drawn from each replay store, by its id, under its limiter, which continues from here.
    pub sampled_steps: BTreeMap<String, u64>,
    /// Environment frames seen by replay when the checkpoint was made.
    pub env_frames: u64,
}

#[derive(Debug, Serialize, Deserialize)]
struct Manifest {
    format: u32,
    counters: Counters,
    env_spec: String,
    model_hash: String,
    files: BTreeMap<String, FileEntry>,
}

#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
struct FileEntry {
    bytes: u64,
    sha256: String,
}

/// The contents of a checkpoint.
#[derive(Debug)]
pub struct Checkpoint {
    /// Where the run stands.
    pub counters: Counters,
    /// The environment, in words.
    pub env_spec: String,
    /// The resolved configuration.
    pub config: Config,
    /// Safetensors bytes.
    pub model: Vec<u8>,
    /// Safetensors bytes.
    pub optimizer: Vec<u8>,
}

impl Checkpoint {
    /// Writes the checkpoint into `dir`, durably, and removes all but the newest `keep`.
    ///
    /// # Errors
    /// Where the disk fails; the folders of earlier checkpoints are whole then.
    pub fn save(&self, dir: &Path, keep: usize) -> anyhow::Result<PathBuf> {
        fs::create_dir_all(dir).with_context(|| format!("cannot create {}", dir.display()))?;
        for stale in temporary_folders(dir)? {
            fs::remove_dir_all(&stale)
                .with_context(|| format!("cannot remove {}", stale.display()))?;
        }
        let name = format!("{:08}", self.counters.updates);
        let (partial, target) = (dir.join(format!(".{name}.partial")), dir.join(&name));
        fs::create_dir(&partial).with_context(|| format!("cannot create {}", partial.display()))?;

        let mut files = BTreeMap::new();
        for (file, bytes) in [
            (MODEL, self.model.as_slice()),
            (OPTIMIZER, self.optimizer.as_slice()),
            (CONFIG, self.config.to_toml().as_bytes()),
        ] {
            write_synced(&partial.join(file), bytes)?;
            files.insert(file.to_owned(), entry(bytes));
        }
        let manifest = Manifest {
            format: FORMAT,
            counters: self.counters.clone(),
            env_spec: self.env_spec.clone(),
            model_hash: self.config.model_hash(),
            files,
        };
        write_synced(
            &partial.join(MANIFEST),
            &serde_json::to_vec_pretty(&manifest)?,
        )?;
        sync_dir(&partial)?;
        if target.exists() {
            // A run that went back to an earlier checkpoint comes by this number again.
            fs::remove_dir_all(&target)
                .with_context(|| format!("cannot remove {}", target.display()))?;
        }
        fs::rename(&partial, &target)
            .with_context(|| format!("cannot create {}", target.display()))?;
        sync_dir(dir)?;

        for old in numbered_folders(dir)?.into_iter().skip(keep) {
            fs::remove_dir_all(&old).with_context(|| format!("cannot remove {}", old.display()))?;
        }
        Ok(target)
    }

    /// Loads one checkpoint folder.
    ///
    /// # Errors
    /// Names the file that is missing, damaged, or of another format.
    pub fn load(folder: &Path) -> anyhow::Result<Self> {
        let manifest = read(&folder.join(MANIFEST))?;
        let manifest: Manifest = serde_json::from_slice(&manifest)
            .with_context(|| format!("{} is damaged", folder.join(MANIFEST).display()))?;
        ensure!(
            manifest.format == FORMAT,
            "{} has format {}, this build reads format {FORMAT}",
            folder.display(),
            manifest.format
        );
        let file = |name: &str| -> anyhow::Result<Vec<u8>> {
            let path = folder.join(name);
            let bytes = read(&path)?;
            ensure!(
                manifest.files.get(name) == Some(&entry(&bytes)),
                "{} is damaged: size or hash differ from the manifest",
                path.display()
            );
            Ok(bytes)
        };
        let (model, optimizer) = (file(MODEL)?, file(OPTIMIZER)?);
        file(CONFIG)?;
        let config = Config::from_file(&folder.join(CONFIG))?;
        Ok(Self {
            counters: manifest.counters,
            env_spec: manifest.env_spec,
            config,
            model,
            optimizer,
        })
    }

    /// Loads the newest valid checkpoint in `dir`; none where there is none at all.
    ///
    /// # Errors
    /// Where there are checkpoints and every one of them is damaged: starting anew would hide that.
    pub fn load_newest(dir: &Path) -> anyhow::Result<Option<Self>> {
        if !dir.exists() {
            return Ok(None);
        }
        let folders = numbered_folders(dir)?;
        for folder in &folders {
            match Self::load(folder) {
                Ok(checkpoint) => return Ok(Some(checkpoint)),
                Err(error) => tracing::warn!(
                    error = format!("{error:#}"),
                    "passing over a damaged checkpoint"
                ),
            }
        }
        if folders.is_empty() {
            return Ok(None);
        }
        bail!(
            "all {} checkpoints in {} are damaged; restore one, or move the folder away to start anew",
            folders.len(),
            dir.display()
        );
    }

    /// Finds a checkpoint in `path`: a checkpoint folder, a folder of checkpoints, or a run directory.
    ///
    /// # Errors
    /// Says where it looked.
    pub fn find(path: &Path) -> anyhow::Result<Self> {
        if path.join(MANIFEST).exists() {
            return Self::load(path);
        }
        for dir in [path.to_owned(), path.join("checkpoints")] {
            if let Some(checkpoint) = Self::load_newest(&dir)? {
                return Ok(checkpoint);
            }
        }
        bail!(
            "no checkpoint in {0} or {0}/checkpoints; give a run directory or a checkpoint folder",
            path.display()
        );
    }
}

fn entry(bytes: &[u8]) -> FileEntry {
    FileEntry {
        bytes: bytes.len() as u64,
        sha256: Sha256::digest(bytes)
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect(),
    }
}

fn read(path: &Path) -> anyhow::Result<Vec<u8>> {
    fs::read(path).with_context(|| format!("cannot read {}", path.display()))
}

fn write_synced(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let write = || -> std::io::Result<()> {
        let mut file = File::create_new(path)?;
        file.write_all(bytes)?;
        file.sync_all()
    };
    write().with_context(|| format!("cannot write {}", path.display()))
}

fn sync_dir(dir: &Path) -> anyhow::Result<()> {
    File::open(dir)
        .and_then(|dir| dir.sync_all())
        .with_context(|| format!("cannot sync {}", dir.display()))
}

/// Checkpoint folders, newest first.
fn numbered_folders(dir: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut found = entries(dir, |name| {
        !name.is_empty() && name.bytes().all(|b| b.is_ascii_digit())
    })?;
    found.sort();
    found.reverse();
    Ok(found)
}

/// What a writer that was killed left behind.
fn temporary_folders(dir: &Path) -> anyhow::Result<Vec<PathBuf>> {
    entries(dir, |name| {
        name.starts_with('.') && name.ends_with(".partial")
    })
}

fn entries(dir: &Path, wanted: impl Fn(&str) -> bool) -> anyhow::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).with_context(|| format!("cannot read {}", dir.display()))? {
        let entry = entry.with_context(|| format!("cannot read {}", dir.display()))?;
        if entry.file_name().to_str().is_some_and(&wanted) {
            found.push(entry.path());
        }
    }
    Ok(found)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn checkpoint(updates: u64) -> Checkpoint {
        Checkpoint {
            counters: Counters {
                updates,
                sampled_steps: BTreeMap::from([("store".to_owned(), 10 * updates)]),
                env_frames: 20 * updates,
            },
            env_spec: "test".into(),
            config: Config::default(),
            model: vec![updates as u8; 100],
            optimizer: vec![1; 50],
        }
    }

    #[test]
    fn the_newest_is_loaded_and_old_ones_go() {
        let dir = tempfile::tempdir().unwrap();
        for updates in [5, 10, 100] {
            checkpoint(updates).save(dir.path(), 2).unwrap();
        }
        let newest = Checkpoint::load_newest(dir.path()).unwrap().unwrap();
        assert_eq!(newest.counters, checkpoint(100).counters);
        assert_eq!(newest.model, checkpoint(100).model);
        assert_eq!(numbered_folders(dir.path()).unwrap().len(), 2);
    }

    #[test]
    fn any_damage_falls_back_to_the_one_before() {
        for file in [MODEL, OPTIMIZER, CONFIG, MANIFEST] {
            let dir = tempfile::tempdir().unwrap();
            checkpoint(1).save(dir.path(), 3).unwrap();
            let newest = checkpoint(2).save(dir.path(), 3).unwrap();
            let path = newest.join(file);
            let mut bytes = fs::read(&path).unwrap();
            let middle = bytes.len() / 2;
            bytes.truncate(middle);
            fs::write(&path, bytes).unwrap();
            let loaded = Checkpoint::load_newest(dir.path()).unwrap().unwrap();
            assert_eq!(loaded.counters.updates, 1, "{file} was cut");
        }
    }

    #[test]
    fn nothing_is_none_but_only_damage_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        assert!(Checkpoint::load_newest(dir.path()).unwrap().is_none());
        let folder = checkpoint(1).save(dir.path(), 2).unwrap();
        fs::remove_file(folder.join(MODEL)).unwrap();
        let error = Checkpoint::load_newest(dir.path()).unwrap_err().to_string();
        assert!(error.contains("damaged"), "{error}");
    }

    #[test]
    fn a_writer_killed_midway_leaves_the_old_and_no_rubbish() {
        let dir = tempfile::tempdir().unwrap();
        checkpoint(1).save(dir.path(), 2).unwrap();
        let partial = dir.path().join(".00000002.partial");
        fs::create_dir(&partial).unwrap();
        fs::write(partial.join(MODEL), b"half").unwrap();
        assert_eq!(
            Checkpoint::load_newest(dir.path())
                .unwrap()
                .unwrap()
                .counters
                .updates,
            1
        );
        checkpoint(2).save(dir.path(), 2).unwrap();
        assert!(!partial.exists());
        assert_eq!(
            Checkpoint::load_newest(dir.path())
                .unwrap()
                .unwrap()
                .counters
                .updates,
            2
        );
    }
}
