//! What can go wrong in a store.

use std::io;
use std::path::{Path, PathBuf};

/// A failure of the store. Messages name the thing and the cure.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// Another process writes to the folder.
    #[error("replay folder {} is in use by another process; stop that process or choose another folder", .folder.display())]
    FolderInUse {
        /// The locked folder.
        folder: PathBuf,
    },
    /// The folder was written by a build that lays records out differently.
    #[error(
        "replay folder {} has format `{found}` where this build reads `{expected}`; use the build that wrote it or choose another folder",
        .folder.display()
    )]
    Format {
        /// The folder.
        folder: PathBuf,
        /// What its `FORMAT` file says.
        found: String,
        /// What this build reads and writes.
        expected: &'static str,
    },
    /// The folder's identity file is damaged.
    #[error("{} is damaged; restore it or choose another folder", .path.display())]
    Identity {
        /// The identity file.
        path: PathBuf,
    },
    /// The disk, or the owner's quota, is full; nothing of the refused group was kept, and the store still serves.
    #[error("no space is left for replay segment {}; free space or lower the replay capacity", .path.display())]
    Full {
        /// The segment that could not grow.
        path: PathBuf,
    },
    /// An operating system error that leaves the store usable.
    #[error("cannot {action} {}: {source}", .path.display())]
    Io {
        /// What was tried, as a verb.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// A failed sync: what the disk holds is unknown, so the process must end and reopen the folder.
    #[error("cannot sync {}: {source}; the disk's state is unknown, restart to recover what is durable", .path.display())]
    Sync {
        /// The segment or its folder.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// An earlier [`ReplayError::Sync`] or failed rollback ended this log.
    #[error("the replay log in {} stopped after an earlier disk failure; restart to recover what is durable", .folder.display())]
    Stopped {
        /// The folder.
        folder: PathBuf,
    },
    /// A stored record is damaged.
    #[error("record at byte {offset} of {} is damaged: {reason}", .path.display())]
    Damaged {
        /// The segment.
        path: PathBuf,
        /// Byte offset of the record in the segment.
        offset: u64,
        /// What the check found.
        reason: &'static str,
    },
    /// A chunk that cannot be stored as it is.
    #[error("chunk {seq} of `{actor_id}` cannot be stored: {reason}")]
    InvalidChunk {
        /// The chunk's actor.
        actor_id: String,
        /// The chunk's sequence number.
        seq: u64,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// A table whose settings are out of range.
    #[error("replay table `{table}` cannot be used: {reason}")]
    InvalidTable {
        /// The table.
        table: String,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// A priority that is negative or no number.
    #[error(
        "priority {priority} of step {start_step} of episode {episode_id} is out of range; send finite priorities of 0 or greater"
    )]
    InvalidPriority {
        /// The episode.
        episode_id: u64,
        /// Index within the episode of the sequence's first step.
        start_step: u32,
        /// The priority.
        priority: f32,
    },
    /// Priorities for a table that does not draw by them.
    #[error(
        "replay table `{table}` has no priorities; give it the selector `prioritized` or send it none"
    )]
    NoPriorities {
        /// The table.
        table: String,
    },
    /// A peer of an older epoch.
    #[error(
        "actor `{actor_id}` epoch {epoch} is fenced off by epoch {newer}; a newer process with this actor id is connected, stop one of them"
    )]
    Fenced {
        /// The actor.
        actor_id: String,
        /// The refused epoch.
        epoch: u64,
        /// The epoch that is valid.
        newer: u64,
    },
}

/// Whether there is no room: on the disk, or in the owner's quota.
pub(crate) fn is_full(kind: io::ErrorKind) -> bool {
    matches!(
        kind,
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded
    )
}

impl ReplayError {
    /// Whether the process must end: the state of the disk is unknown.
    pub fn is_fatal(&self) -> bool {
        matches!(self, Self::Sync { .. } | Self::Stopped { .. })
    }

    pub(crate) fn sync(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Sync {
            path: path.to_owned(),
            source,
        }
    }

    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| {
            if is_full(source.kind()) {
                Self::Full {
                    path: path.to_owned(),
                }
            } else {
                Self::Io {
                    action,
                    path: path.to_owned(),
                    source,
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_and_a_spent_quota_are_both_waited_for() {
        for kind in [io::ErrorKind::StorageFull, io::ErrorKind::QuotaExceeded] {
            let error = ReplayError::io("write", Path::new("1.seg"))(kind.into());
            assert!(matches!(error, ReplayError::Full { .. }), "{error}");
        }
        let error = ReplayError::io("write", Path::new("1.seg"))(io::ErrorKind::NotFound.into());
        assert!(matches!(error, ReplayError::Io { .. }), "{error}");
    }
}
