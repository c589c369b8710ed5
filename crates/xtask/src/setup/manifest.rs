//! `.native/*.json`: what setup made, so that the next setup sees in a moment that it still stands.

use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

/// Many small files: one hash for all of them.
const HEADERS: &str = "include";

/// What was made: files with their sizes and hashes, or links to a libtorch of the user.
#[derive(Debug)]
pub(super) struct Manifest(Value);

impl Manifest {
    /// The manifest `name` in `native`, unless there is none that we understand.
    pub(super) fn read(native: &Path, name: &str) -> Option<Self> {
        let bytes = fs::read(native.join(name)).ok()?;
        serde_json::from_slice(&bytes).ok().map(Self)
    }

    /// Hashes what is in `folder`; `wheels` are the files it was unpacked from.
    pub(super) fn of_files(folder: &Path, wheels: &[PathBuf]) -> Result<Self> {
        let headers = folder.join(HEADERS);
        let mut files = serde_json::Map::new();
        for path in tree(folder)? {
            if !path.starts_with(&headers) {
                files.insert(relative(&path, folder), entry(&path)?);
            }
        }
        let mut fetched = serde_json::Map::new();
        for path in wheels {
            let name = path
                .file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned();
            fetched.insert(name, entry(path)?);
        }
        let include_sha256 = if headers.is_dir() {
            Some(hash_tree(&headers)?)
        } else {
            None
        };
        Ok(Self(json!({
            "fetched": fetched,
            "files": files,
            "include_sha256": include_sha256,
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

    /// Whether the files come from wheels of exactly these hashes.
    pub(super) fn is_of_wheels<'a>(&self, sha256: impl IntoIterator<Item = &'a str>) -> bool {
        let fetched = self.0["fetched"].as_object().into_iter().flatten();
        let mut fetched: Vec<_> = fetched
            .map(|(_, entry)| entry["sha256"].as_str().unwrap_or_default())
            .collect();
        let mut expected: Vec<_> = sha256.into_iter().collect();
        fetched.sort_unstable();
        expected.sort_unstable();
        fetched == expected
    }

    /// Writes the manifest, which makes the setup complete: last, and whole or not at all.
    pub(super) fn write(&self, native: &Path, name: &str) -> Result<()> {
        let path = native.join(name);
        let part = native.join(format!("{name}.tmp"));
        fs::write(&part, format!("{:#}\n", self.0))
            .and_then(|()| fs::rename(&part, &path))
            .with_context(|| format!("cannot write {}", path.display()))
    }

    /// The first thing in `folder` that is not as this manifest says: by presence and size, with `full`
    /// also by hash.
    pub(super) fn mismatch(&self, folder: &Path, full: bool) -> Option<String> {
        if self.linked().is_some() {
            return None;
        }
        let Some(files) = self.0["files"].as_object() else {
            return Some("its manifest lists no files".to_owned());
        };
        for (name, expected) in files {
            let path = folder.join(name);
            let bytes = fs::metadata(&path).ok().map(|metadata| metadata.len());
            if bytes != expected["bytes"].as_u64() {
                return Some(format!("{name} has not the size that its manifest says"));
            }
            if full && entry(&path).ok().as_ref() != Some(expected) {
                return Some(format!("{name} has not the hash that its manifest says"));
            }
        }
        let headers = || hash_tree(&folder.join(HEADERS)).ok();
        if full && headers().as_deref() != self.0["include_sha256"].as_str() {
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
        let folder = dir.path().join("library");
        let write = |name: &str, content: &str| {
            let path = folder.join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, content).unwrap();
        };
        write("include/header.h", "#pragma once");
        write("lib/library.so", "library");
        write("build-version", "1");
        let check = |full| {
            let manifest = Manifest::read(dir.path(), "library.json").unwrap();
            manifest.mismatch(&folder, full).unwrap_or_default()
        };
        Manifest::of_files(&folder, &[])
            .unwrap()
            .write(dir.path(), "library.json")
            .unwrap();
        assert_eq!(check(true), "");

        write("lib/library.so", "libravy");
        assert_eq!(check(false), "");
        assert!(check(true).contains("lib/library.so"));
        write("lib/library.so", "short");
        assert!(check(false).contains("lib/library.so"));
        write("lib/library.so", "library");
        write("include/header.h", "#pragma twice");
        assert!(check(true).contains("headers"));
        fs::remove_file(folder.join("build-version")).unwrap();
        assert!(check(false).contains("build-version"));
    }

    #[test]
    fn other_wheels_than_the_pinned_ones_are_seen() {
        let dir = tempfile::tempdir().unwrap();
        let wheel = dir.path().join("a.whl");
        fs::write(&wheel, "a").unwrap();
        let hash = "ca978112ca1bbdcafac231b39a23dc4da786eff8147c4e72b9807785afee48bb";
        let manifest = Manifest::of_files(&dir.path().join("none"), std::slice::from_ref(&wheel));
        assert!(manifest.is_err(), "a folder that is not there");
        let manifest = Manifest::of_files(dir.path(), &[wheel]).unwrap();
        assert!(manifest.is_of_wheels([hash]));
        assert!(!manifest.is_of_wheels(["0"]));
        assert!(!manifest.is_of_wheels([hash, "0"]));
    }
}
