//! `.native/manifest.json`: what setup made, so that the next setup sees in a moment that it still stands.

use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::linked;

const FILE: &str = "manifest.json";

/// What was made: files with their sizes and hashes, or links to a libtorch of the user.
#[derive(Debug)]
pub(super) struct Manifest(Value);

impl Manifest {
    /// The manifest in `native`, unless there is none that we understand.
    pub(super) fn read(native: &Path) -> Option<Self> {
        let bytes = fs::read(native.join(FILE)).ok()?;
        serde_json::from_slice(&bytes).ok().map(Self)
    }

    /// Hashes what is in `libtorch`; `wheels` are the files it was unpacked from.
    pub(super) fn of_files(libtorch: &Path, wheels: &[PathBuf]) -> Result<Self> {
        let mut files = serde_json::Map::new();
        for path in tree(&libtorch.join("lib"))? {
            files.insert(relative(&path, libtorch), entry(&path)?);
        }
        let build_version = libtorch.join("build-version");
        files.insert("build-version".to_owned(), entry(&build_version)?);
        let mut fetched = serde_json::Map::new();
        for path in wheels {
            let name = path
                .file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned();
            fetched.insert(name, entry(path)?);
        }
        Ok(Self(json!({
            "fetched": fetched,
            "files": files,
            "include_sha256": hash_tree(&libtorch.join("include"))?,
        })))
    }

    /// For a folder of links to `path`.
    pub(super) fn of_link(path: &Path) -> Self {
        Self(json!({ "linked": path }))
    }

    /// The libtorch that is linked to, if it is.
    pub(super) fn linked(&self) -> Option<&Path> {
        self.0["linked"].as_str().map(Path::new)
    }

    /// Writes the manifest, which makes the setup complete: last, and whole or not at all.
    pub(super) fn write(&self, native: &Path) -> Result<()> {
        let path = native.join(FILE);
        let part = native.join("manifest.json.tmp");
        fs::write(&part, format!("{:#}\n", self.0))
            .and_then(|()| fs::rename(&part, &path))
            .with_context(|| format!("cannot write {}", path.display()))
    }

    /// The first thing in `libtorch` that is not as this manifest says: by presence and size, with `full`
    /// also by hash.
    pub(super) fn mismatch(&self, libtorch: &Path, full: bool) -> Option<String> {
        if let Some(missing) = linked::missing(libtorch) {
            return Some(format!("{missing} is missing"));
        }
        if self.linked().is_some() {
            return None;
        }
        let Some(files) = self.0["files"].as_object() else {
            return Some("its manifest lists no files".to_owned());
        };
        for (name, expected) in files {
            let path = libtorch.join(name);
            let bytes = fs::metadata(&path).ok().map(|metadata| metadata.len());
            if bytes != expected["bytes"].as_u64() {
                return Some(format!("{name} has not the size that its manifest says"));
            }
            if full && entry(&path).ok().as_ref() != Some(expected) {
                return Some(format!("{name} has not the hash that its manifest says"));
            }
        }
        let include = || hash_tree(&libtorch.join("include")).ok();
        if full && include().as_deref() != self.0["include_sha256"].as_str() {
            return Some("the headers have not the hash that its manifest says".to_owned());
        }
        None
    }
}

/// Size and hash of one file.
fn entry(path: &Path) -> Result<Value> {
    let bytes = fs::metadata(path)
        .with_context(|| format!("cannot read {}", path.display()))?
        .len();
    let mut hash = Sha256::new();
    add_file(&mut hash, path)?;
    Ok(json!({ "bytes": bytes, "sha256": hex(&hash.finalize()) }))
}

/// One hash over names, sizes and contents of all files below `folder`.
fn hash_tree(folder: &Path) -> Result<String> {
    let mut hash = Sha256::new();
    for path in tree(folder)? {
        let bytes = fs::metadata(&path)?.len();
        hash.update(format!("{}\0{bytes}\0", relative(&path, folder)));
        add_file(&mut hash, &path)?;
    }
    Ok(hex(&hash.finalize()))
}

fn add_file(hash: &mut Sha256, path: &Path) -> Result<()> {
    let mut file = File::open(path).with_context(|| format!("cannot open {}", path.display()))?;
    let mut buffer = vec![0; 1 << 18];
    loop {
        match file
            .read(&mut buffer)
            .with_context(|| format!("cannot read {}", path.display()))?
        {
            0 => return Ok(()),
            bytes => hash.update(&buffer[..bytes]),
        }
    }
}

/// All files below `folder`, sorted.
fn tree(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        let entries =
            fs::read_dir(&folder).with_context(|| format!("cannot list {}", folder.display()))?;
        for entry in entries {
            let path = entry?.path();
            if path.is_dir() {
                folders.push(path);
            } else {
                files.push(path);
            }
        }
    }
    files.sort();
    Ok(files)
}

fn relative(path: &Path, base: &Path) -> String {
    path.strip_prefix(base)
        .unwrap_or(path)
        .to_string_lossy()
        .into_owned()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damage_is_seen_by_size_at_once_and_by_hash_when_asked() {
        let dir = tempfile::tempdir().unwrap();
        let libtorch = dir.path().join("libtorch");
        let write = |name: &str, content: &str| {
            let path = libtorch.join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, content).unwrap();
        };
        let header = "include/torch/csrc/api/include/torch/torch.h";
        write(header, "#pragma once");
        write("lib/libtorch.so", "library");
        write("lib/libtorch.dylib", "library");
        write("build-version", "1");
        Manifest::of_files(&libtorch, &[])
            .unwrap()
            .write(dir.path())
            .unwrap();
        let manifest = Manifest::read(dir.path()).unwrap();
        assert_eq!(manifest.mismatch(&libtorch, true), None);

        write("lib/libtorch.so", "libravy");
        assert_eq!(manifest.mismatch(&libtorch, false), None);
        assert!(
            manifest
                .mismatch(&libtorch, true)
                .unwrap()
                .contains("lib/libtorch.so")
        );
        write("lib/libtorch.so", "short");
        assert!(
            manifest
                .mismatch(&libtorch, false)
                .unwrap()
                .contains("lib/libtorch.so")
        );
        write("lib/libtorch.so", "library");
        write(header, "#pragma twice");
        assert!(
            manifest
                .mismatch(&libtorch, true)
                .unwrap()
                .contains("headers")
        );
        fs::remove_file(libtorch.join(header)).unwrap();
        assert!(
            manifest
                .mismatch(&libtorch, false)
                .unwrap()
                .contains("torch.h")
        );
    }
}
