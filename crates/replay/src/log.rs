//! The append-only log: segment files written by one thread.
//!
//! *Written* and *durable* are different facts and different types: only [`SegmentLog::sync`] turns one into
//! the other.

use std::collections::BTreeMap;
use std::fs::{self, OpenOptions};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::Arc;

use crate::ReplayError;
use crate::error::is_full;
use crate::failpoint;
use crate::folder::Folder;
use crate::record::{self, Record, Snapshot};
use crate::recover::{self, LogRecovery, Recovered};
use crate::segment::{ChunkRef, Segment};

/// A place in the log.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct LogPosition {
    /// Number of the segment.
    pub segment: u64,
    /// Byte offset in the segment.
    pub offset: u64,
}

/// Everything before it was handed to the operating system. A crash of the machine may lose it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct WrittenPosition(pub LogPosition);

/// Everything before it survived `fdatasync`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct DurablePosition(pub LogPosition);

/// What an append did.
#[derive(Debug)]
pub struct Appended {
    /// Where the chunks among the records lie, in order.
    pub chunks: Vec<ChunkRef>,
    /// The new end of the log.
    pub written: WrittenPosition,
}

/// The log of one folder. It holds the folder's lock for as long as it lives.
#[derive(Debug)]
pub struct SegmentLog {
    folder: Folder,
    segment_bytes: u64,
    segments: BTreeMap<u64, Arc<Segment>>,
    /// The segment that grows; none before the first append to a fresh folder.
    current: Option<Arc<Segment>>,
    last_number: u64,
    written: u64,
    durable: u64,
    stopped: bool,
}

impl SegmentLog {
    /// Opens or makes the log in `folder`; segments are closed once they exceed `segment_bytes`.
    ///
    /// Damaged records are skipped and reported, a torn tail is cut and reported.
    ///
    /// # Errors
    /// [`ReplayError`] where the folder is in use, has another format or cannot be read.
    pub fn open(folder: &Path, segment_bytes: u64) -> Result<(Self, LogRecovery), ReplayError> {
        Self::open_with(Folder::open(folder)?, segment_bytes, &mut |_| {})
    }

    /// Like [`SegmentLog::open`]; `visit` sees every readable record in order.
    pub(crate) fn open_with(
        folder: Folder,
        segment_bytes: u64,
        visit: &mut dyn FnMut(Recovered),
    ) -> Result<(Self, LogRecovery), ReplayError> {
        let found = recover::recover(&folder, visit)?;
        let log = Self {
            folder,
            segment_bytes,
            segments: found.segments,
            current: found.current,
            last_number: found.last_number,
            written: found.end,
            durable: found.end,
            stopped: false,
        };
        Ok((log, found.report))
    }

    /// Writes `records` behind the end of the log. A new segment starts with `snapshot`, the state before
    /// these records.
    ///
    /// # Errors
    /// On [`ReplayError::Full`], [`ReplayError::Io`] and [`ReplayError::InvalidChunk`] nothing of `records`
    /// was kept and the log stays usable; [`ReplayError::is_fatal`] errors end it.
    pub fn append(
        &mut self,
        records: &[Record],
        snapshot: impl FnOnce() -> Snapshot,
    ) -> Result<Appended, ReplayError> {
        self.check_running()?;
        for record in records {
            if let Record::Chunk(chunk) = record {
                record::check(chunk)?;
            }
        }
        let segment = self.room(snapshot)?;
        let mut frames = Vec::new();
        let mut chunks = Vec::new();
        for record in records {
            let offset = self.written + frames.len() as u64;
            let frame_bytes = record::encode(record, self.durable, &mut frames);
            if let Record::Chunk(chunk) = record {
                chunks.push(ChunkRef {
                    segment: segment.clone(),
                    offset,
                    frame_bytes: frame_bytes as u32,
                    first_step: chunk.first_step,
                    steps: chunk.steps,
                });
            }
        }
        let written = failpoint::reach("append-before-write")
            .and_then(|()| segment.file.write_all_at(&frames, self.written))
            .and_then(|()| failpoint::reach("append-before-sync"));
        if let Err(error) = written {
            self.roll_back(&segment);
            return Err(ReplayError::io("write to", &segment.path)(error));
        }
        self.written += frames.len() as u64;
        Ok(Appended {
            chunks,
            written: self.written(),
        })
    }

    /// Makes everything written durable.
    ///
    /// # Errors
    /// [`ReplayError::Sync`], which is fatal: after a failed sync the kernel may have dropped the pages, so
    /// trying again could report success for lost data.
    pub fn sync(&mut self) -> Result<DurablePosition, ReplayError> {
        self.check_running()?;
        if let Some(segment) = self
            .current
            .as_ref()
            .filter(|_| self.durable < self.written)
        {
            let synced = failpoint::reach("append-sync").and_then(|()| segment.file.sync_data());
            if let Err(source) = synced {
                self.stopped = true;
                return Err(ReplayError::Sync {
                    path: segment.path.clone(),
                    source,
                });
            }
            self.durable = self.written;
        }
        Ok(self.durable())
    }

    /// The end of what was written.
    pub fn written(&self) -> WrittenPosition {
        WrittenPosition(LogPosition {
            segment: self.last_number,
            offset: self.written,
        })
    }

    /// The end of what is durable.
    pub fn durable(&self) -> DurablePosition {
        DurablePosition(LogPosition {
            segment: self.last_number,
            offset: self.durable,
        })
    }

    pub(crate) fn folder(&self) -> &Folder {
        &self.folder
    }

    /// Deletes the closed segments that `keep` does not name; returns how many.
    pub(crate) fn delete_segments(
        &mut self,
        keep: impl Fn(u64) -> bool,
    ) -> Result<usize, ReplayError> {
        let current = self.current.as_ref().map(|segment| segment.number);
        let dead: Vec<_> = self
            .segments
            .values()
            .filter(|segment| Some(segment.number) != current && !keep(segment.number))
            .cloned()
            .collect();
        for segment in &dead {
            failpoint::reach("evict-before-delete")
                .and_then(|()| fs::remove_file(&segment.path))
                .and_then(|()| failpoint::reach("evict-after-delete"))
                .map_err(ReplayError::io("delete", &segment.path))?;
            self.segments.remove(&segment.number);
        }
        Ok(dead.len())
    }

    /// The growing segment, a fresh one where the last is full.
    fn room(&mut self, snapshot: impl FnOnce() -> Snapshot) -> Result<Arc<Segment>, ReplayError> {
        match &self.current {
            Some(segment) if self.written < self.segment_bytes => Ok(segment.clone()),
            _ => {
                self.sync()?;
                self.start_segment(snapshot())
            }
        }
    }

    fn start_segment(&mut self, mut snapshot: Snapshot) -> Result<Arc<Segment>, ReplayError> {
        if self.current.is_some() {
            snapshot.closed = self.durable().0;
        }
        let number = self.last_number + 1;
        let path = Segment::path_of(self.folder.path(), number);
        let mut frame = Vec::new();
        record::encode(&Record::Snapshot(snapshot), 0, &mut frame);
        let created = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(true)
            .open(&path)
            .and_then(|file| {
                failpoint::reach("roll-created")?;
                file.write_all_at(&frame, 0)?;
                Ok(file)
            })
            .map_err(ReplayError::io("create", &path));
        let file = match created {
            Ok(file) => file,
            Err(error) => {
                // The next attempt truncates it, and opening deletes or accepts it: nothing depends on this.
                let _ = fs::remove_file(&path);
                return Err(error);
            }
        };
        let synced = file
            .sync_all()
            .and_then(|()| failpoint::reach("roll-before-folder-sync"))
            .map_err(|source| match source.kind() {
                kind if is_full(kind) => ReplayError::io("sync", &path)(source),
                _ => ReplayError::sync(&path)(source),
            })
            .and_then(|()| self.folder.sync());
        if let Err(error) = synced {
            if error.is_fatal() {
                self.stopped = true;
            } else {
                let _ = fs::remove_file(&path);
            }
            return Err(error);
        }
        let segment = Arc::new(Segment { number, path, file });
        self.segments.insert(number, segment.clone());
        self.current = Some(segment.clone());
        self.last_number = number;
        self.written = frame.len() as u64;
        self.durable = self.written;
        Ok(segment)
    }

    /// Cuts what a failed write left; where even that fails the log must not grow any more.
    fn roll_back(&mut self, segment: &Segment) {
        if let Err(error) = segment.file.set_len(self.written) {
            tracing::error!(segment = %segment.path.display(), %error, "cannot cut a failed write");
            self.stopped = true;
        }
    }

    fn check_running(&self) -> Result<(), ReplayError> {
        if self.stopped {
            return Err(ReplayError::Stopped {
                folder: self.folder.path().to_owned(),
            });
        }
        Ok(())
    }
}

impl Drop for SegmentLog {
    /// Where this note is missing, after a crash, opening has to take damage in the newest group for a torn
    /// write.
    fn drop(&mut self) {
        if self.current.is_some()
            && let Err(error) = self.folder.set_durable(self.durable().0)
        {
            tracing::warn!(%error, "cannot note the durable end of the replay log");
        }
    }
}

#[cfg(test)]
#[path = "log_tests.rs"]
mod tests;
