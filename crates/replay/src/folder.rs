//! The store's folder: its single-writer lock, its format, its name and what it belongs to.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::{LogPosition, ReplayError};

pub(crate) const FORMAT: &str = "isodream-replay 2";
const FORMAT_FILE: &str = "FORMAT";
const ID_FILE: &str = "ID";
const IDENTITY_FILE: &str = "IDENTITY";
const DURABLE_FILE: &str = "DURABLE";
const LOCK_FILE: &str = "LOCK";

/// What a store's experience was collected from; two stores of different identity never mix.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct StoreIdentity {
    /// Hash of the environment spec, without line breaks.
    pub env_spec_hash: String,
    /// The spec in words, for error messages.
    pub env_spec: String,
}

/// A locked folder. Dropping it, or the death of the process, releases the lock.
#[derive(Debug)]
pub(crate) struct Folder {
    path: PathBuf,
    id: String,
    _lock: File,
}

impl Folder {
    /// Makes the folder where it is missing, locks it and checks its format.
    pub(crate) fn open(path: &Path) -> Result<Self, ReplayError> {
        fs::create_dir_all(path).map_err(ReplayError::io("create replay folder", path))?;
        let lock_path = path.join(LOCK_FILE);
        let lock = OpenOptions::new()
            .create(true)
            .truncate(false)
            .write(true)
            .open(&lock_path)
            .map_err(ReplayError::io("open lock file", &lock_path))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(ReplayError::FolderInUse {
                    folder: path.to_owned(),
                });
            }
            Err(TryLockError::Error(error)) => {
                return Err(ReplayError::io("lock", &lock_path)(error));
            }
        }
        let mut folder = Self {
            path: path.to_owned(),
            id: String::new(),
            _lock: lock,
        };
        folder.check_format()?;
        folder.id = folder.load_id()?;
        Ok(folder)
    }

    /// Names the store for as long as it exists, also at another path.
    pub(crate) fn id(&self) -> &str {
        &self.id
    }

    fn load_id(&self) -> Result<String, ReplayError> {
        let path = self.path.join(ID_FILE);
        match fs::read_to_string(&path) {
            Ok(text) => Ok(text.trim_end().to_owned()),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let id = format!("{:032x}", rand::random::<u128>());
                self.write_durably(ID_FILE, format!("{id}\n").as_bytes())?;
                Ok(id)
            }
            Err(error) => Err(ReplayError::io("read", &path)(error)),
        }
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    fn check_format(&self) -> Result<(), ReplayError> {
        if read_format(&self.path)? {
            return Ok(());
        }
        self.write_durably(FORMAT_FILE, format!("{FORMAT}\n").as_bytes())
    }

    /// What the store belongs to; none before the first handshake.
    pub(crate) fn identity(&self) -> Result<Option<StoreIdentity>, ReplayError> {
        read_identity(&self.path)
    }

    /// Fixes what the store belongs to, durably.
    pub(crate) fn set_identity(&self, identity: &StoreIdentity) -> Result<(), ReplayError> {
        let text = format!("{}\n{}", identity.env_spec_hash, identity.env_spec);
        self.write_durably(IDENTITY_FILE, text.as_bytes())
    }

    /// A position that everything before it is known to be durable up to; the start where none was noted.
    pub(crate) fn durable(&self) -> Result<LogPosition, ReplayError> {
        read_durable(&self.path)
    }

    /// Notes that everything before `position` is durable.
    pub(crate) fn set_durable(&self, position: LogPosition) -> Result<(), ReplayError> {
        let text = format!("{} {}\n", position.segment, position.offset);
        self.write_durably(DURABLE_FILE, text.as_bytes())
    }

    /// Makes entries that were added to or removed from the folder durable.
    pub(crate) fn sync(&self) -> Result<(), ReplayError> {
        File::open(&self.path)
            .and_then(|folder| folder.sync_all())
            .map_err(ReplayError::sync(&self.path))
    }

    /// Replaces a small file: after a crash it holds the old or the new content, never a mixture.
    fn write_durably(&self, name: &str, content: &[u8]) -> Result<(), ReplayError> {
        let path = self.path.join(name);
        let temporary = self.path.join(format!("{name}.new"));
        File::create(&temporary)
            .and_then(|mut file| {
                file.write_all(content)?;
                file.sync_all()
            })
            .and_then(|()| fs::rename(&temporary, &path))
            .map_err(ReplayError::io("write", &path))?;
        self.sync()
    }
}

/// Checks a folder's format; false where it has none yet.
pub(crate) fn read_format(folder: &Path) -> Result<bool, ReplayError> {
    let path = folder.join(FORMAT_FILE);
    match fs::read_to_string(&path) {
        Ok(text) if text.trim_end() == FORMAT => Ok(true),
        Ok(text) => Err(ReplayError::Format {
            folder: folder.to_owned(),
            found: text.trim_end().to_owned(),
            expected: FORMAT,
        }),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(ReplayError::io("read", &path)(error)),
    }
}

pub(crate) fn read_identity(folder: &Path) -> Result<Option<StoreIdentity>, ReplayError> {
    let path = folder.join(IDENTITY_FILE);
    match fs::read_to_string(&path) {
        Ok(text) => {
            let (hash, words) = text
                .split_once('\n')
                .ok_or_else(|| ReplayError::Identity { path: path.clone() })?;
            Ok(Some(StoreIdentity {
                env_spec_hash: hash.to_owned(),
                env_spec: words.to_owned(),
            }))
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) if error.kind() == io::ErrorKind::InvalidData => {
            Err(ReplayError::Identity { path })
        }
        Err(error) => Err(ReplayError::io("read", &path)(error)),
    }
}

pub(crate) fn read_durable(folder: &Path) -> Result<LogPosition, ReplayError> {
    let path = folder.join(DURABLE_FILE);
    match fs::read_to_string(&path) {
        // A damaged note is worth no more than none: it only tells damage from a torn write.
        Ok(text) => Ok(parse_position(&text).unwrap_or_default()),
        Err(error)
            if matches!(
                error.kind(),
                io::ErrorKind::NotFound | io::ErrorKind::InvalidData
            ) =>
        {
            Ok(LogPosition::default())
        }
        Err(error) => Err(ReplayError::io("read", &path)(error)),
    }
}

fn parse_position(text: &str) -> Option<LogPosition> {
    let (segment, offset) = text.strip_suffix('\n')?.split_once(' ')?;
    Some(LogPosition {
        segment: segment.parse().ok()?,
        offset: offset.parse().ok()?,
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn a_second_writer_is_refused_by_the_folders_name() {
        let folder = tempfile::tempdir().unwrap();
        let first = Folder::open(folder.path()).unwrap();
        let error = Folder::open(folder.path()).unwrap_err();
        assert!(matches!(error, ReplayError::FolderInUse { .. }));
        assert!(
            error
                .to_string()
                .contains(&folder.path().display().to_string())
        );
        drop(first);
        Folder::open(folder.path()).unwrap();
    }

    #[test]
    fn another_format_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(FORMAT_FILE), "isodream-replay 1\n").unwrap();
        let error = Folder::open(folder.path()).unwrap_err();
        assert!(error.to_string().contains("isodream-replay 1"), "{error}");
    }

    #[test]
    fn a_store_keeps_its_id_and_no_two_share_one() {
        let (first, second) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let id = Folder::open(first.path()).unwrap().id().to_owned();
        assert_eq!(id.len(), 32);
        assert_eq!(Folder::open(first.path()).unwrap().id(), id);
        assert_ne!(Folder::open(second.path()).unwrap().id(), id);
    }

    #[test]
    fn the_identity_survives_and_damage_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let identity = StoreIdentity {
            env_spec_hash: "00ff".into(),
            env_spec: "highway (64x64)\nsecond line".into(),
        };
        let opened = Folder::open(folder.path()).unwrap();
        assert_eq!(opened.identity().unwrap(), None);
        opened.set_identity(&identity).unwrap();
        drop(opened);
        let opened = Folder::open(folder.path()).unwrap();
        assert_eq!(opened.identity().unwrap(), Some(identity));
        fs::write(folder.path().join(IDENTITY_FILE), [0xff, 0xfe]).unwrap();
        assert!(matches!(
            opened.identity(),
            Err(ReplayError::Identity { .. })
        ));
    }
}
