//! Opening a log: what its segments hold, and what damage did to them.
//!
//! Of closed segments the headers are read, and the payloads only where a header is damaged: a damaged payload
//! is found when it is read or verified. The newest segment is read whole, because its end may be torn.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::Arc;

use crate::failpoint;
use crate::folder::Folder;
use crate::record::{ChunkMeta, Entry, Snapshot};
use crate::scan::{self, Piece, Quarantined};
use crate::segment::{ChunkRef, Segment};
use crate::{LogPosition, Progress, ReplayError};

/// What opening a log found.
#[derive(Debug, Default)]
pub struct LogRecovery {
    /// Segments read.
    pub segments: usize,
    /// Bytes cut from the end of the last segment: a write that a crash interrupted.
    pub torn_bytes: u64,
    /// Damaged stretches elsewhere.
    pub quarantined: Vec<Quarantined>,
}

/// A stored record, met while opening a log.
pub(crate) enum Recovered {
    Chunk(ChunkMeta, ChunkRef),
    Snapshot(Snapshot),
    Progress(Progress),
}

/// A log as it was found.
#[derive(Debug, Default)]
pub(crate) struct Found {
    pub(crate) segments: BTreeMap<u64, Arc<Segment>>,
    /// The segment that can grow on.
    pub(crate) current: Option<Arc<Segment>>,
    pub(crate) last_number: u64,
    /// Where `current` ends; everything before it is durable.
    pub(crate) end: u64,
    pub(crate) report: LogRecovery,
    /// Length in bytes that each segment was found with.
    lengths: BTreeMap<u64, u64>,
}

/// Reads the log in `folder`; `visit` sees every readable record in order.
pub(crate) fn recover(
    folder: &Folder,
    visit: &mut dyn FnMut(Recovered),
) -> Result<Found, ReplayError> {
    let numbers = list_segments(folder.path())?;
    let durable = folder.durable()?;
    let last = numbers.last().copied().unwrap_or(0);
    let mut found = Found {
        // A lost segment's number is not given to another one: what is noted of it would not be true.
        last_number: last.max(durable.segment),
        ..Found::default()
    };
    found.report.segments = numbers.len();
    for number in numbers {
        let path = Segment::path_of(folder.path(), number);
        failpoint::reach("open-segment").map_err(ReplayError::io("open", &path))?;
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .open(&path)
            .map_err(ReplayError::io("open", &path))?;
        let segment = Arc::new(Segment { number, path, file });
        if number == last {
            found.newest(folder, segment, durable, visit)?;
        } else {
            found.closed(segment, visit)?;
        }
    }
    if found.compare_length(folder.path(), durable)
        && let Some(segment) = &found.current
    {
        // The segment grows again over what is lost, and the note is not true of that.
        folder.set_durable(LogPosition {
            segment: segment.number,
            offset: found.end,
        })?;
    }
    Ok(found)
}

impl Found {
    fn closed(
        &mut self,
        segment: Arc<Segment>,
        visit: &mut dyn FnMut(Recovered),
    ) -> Result<(), ReplayError> {
        let bytes = length(&segment)?;
        self.lengths.insert(segment.number, bytes);
        let pieces = match scan::skim(&segment.file, bytes)
            .map_err(ReplayError::io("read", &segment.path))?
        {
            Some(pieces) => pieces,
            None => scan::scan(&read_whole(&segment.file, bytes, &segment.path)?),
        };
        self.take(segment, bytes, pieces, visit);
        Ok(())
    }

    /// Makes the newest segment the growing one, cut where it is torn. A segment without even its first record
    /// was never used and is deleted.
    fn newest(
        &mut self,
        folder: &Folder,
        segment: Arc<Segment>,
        durable: LogPosition,
        visit: &mut dyn FnMut(Recovered),
    ) -> Result<(), ReplayError> {
        let bytes = length(&segment)?;
        self.lengths.insert(segment.number, bytes);
        let content = read_whole(&segment.file, bytes, &segment.path)?;
        let pieces = scan::scan(&content);
        let known = if durable.segment == segment.number {
            durable.offset.min(bytes)
        } else {
            0
        };
        let end = scan::torn_at(&pieces, known).unwrap_or(bytes);
        self.report.torn_bytes = bytes - end;
        if end == 0 {
            fs::remove_file(&segment.path).map_err(ReplayError::io("delete", &segment.path))?;
            return folder.sync();
        }
        if end < bytes {
            segment
                .file
                .set_len(end)
                .map_err(ReplayError::io("cut", &segment.path))?;
        }
        // Also where nothing was cut: a process that died between write and sync leaves records that are
        // readable but not durable, and the index is about to call them durable.
        segment
            .file
            .sync_all()
            .map_err(ReplayError::sync(&segment.path))?;
        self.current = Some(segment.clone());
        self.end = end;
        self.take(segment, end, pieces, visit);
        Ok(())
    }

    /// Hands on what lies before `end` in a segment.
    fn take(
        &mut self,
        segment: Arc<Segment>,
        end: u64,
        pieces: Vec<Piece>,
        visit: &mut dyn FnMut(Recovered),
    ) {
        let folder = segment.path.parent().unwrap_or(Path::new("")).to_owned();
        for piece in pieces {
            match piece {
                Piece::Good { range, .. } | Piece::Bad { range, .. } if range.start >= end => {}
                Piece::Good { range, entry, .. } => visit(match entry {
                    Entry::Chunk(meta) => {
                        let place = ChunkRef {
                            segment: segment.clone(),
                            offset: range.start,
                            frame_bytes: (range.end - range.start) as u32,
                            first_step: meta.first_step,
                            steps: meta.steps,
                        };
                        Recovered::Chunk(meta, place)
                    }
                    Entry::Snapshot(snapshot) => {
                        self.compare_length(&folder, snapshot.closed);
                        Recovered::Snapshot(snapshot)
                    }
                    Entry::Progress(progress) => Recovered::Progress(progress),
                }),
                Piece::Bad { range, reason } => self.report.quarantined.push(Quarantined {
                    segment: segment.path.clone(),
                    offset: range.start,
                    bytes: range.end.min(end) - range.start,
                    reason,
                }),
            }
        }
        self.segments.insert(segment.number, segment);
    }

    /// Whether a segment that is known to have reached up to `end` misses its own, which is reported. A segment
    /// that is gone was evicted.
    fn compare_length(&mut self, folder: &Path, end: LogPosition) -> bool {
        let path = Segment::path_of(folder, end.segment);
        self.lengths.get(&end.segment).is_some_and(|&bytes| {
            scan::note_missing_end(&mut self.report.quarantined, path, bytes, end.offset)
        })
    }
}

fn length(segment: &Segment) -> Result<u64, ReplayError> {
    let metadata = segment.file.metadata();
    Ok(metadata
        .map_err(ReplayError::io("look at", &segment.path))?
        .len())
}

/// The first `bytes` bytes of a file.
pub(crate) fn read_whole(file: &File, bytes: u64, path: &Path) -> Result<Vec<u8>, ReplayError> {
    let mut content = vec![0; bytes as usize];
    file.read_exact_at(&mut content, 0)
        .map_err(ReplayError::io("read", path))?;
    Ok(content)
}

/// Numbers of the segments in a folder, in order.
pub(crate) fn list_segments(folder: &Path) -> Result<Vec<u64>, ReplayError> {
    let mut numbers = Vec::new();
    for entry in fs::read_dir(folder).map_err(ReplayError::io("list", folder))? {
        let entry = entry.map_err(ReplayError::io("list", folder))?;
        if let Some(number) = entry.file_name().to_str().and_then(Segment::number_of) {
            numbers.push(number);
        }
    }
    numbers.sort_unstable();
    Ok(numbers)
}
