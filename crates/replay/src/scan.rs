//! Reading a segment of unknown health: every byte, or the headers alone.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;

use serde::Serialize;

use crate::record::{self, Entry, Header, MAGIC, MAX_HEADER_BYTES, Meta};

/// A damaged stretch that was skipped.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Quarantined {
    /// The segment.
    pub segment: PathBuf,
    /// Byte offset of the stretch.
    pub offset: u64,
    /// Length of the stretch in bytes.
    pub bytes: u64,
    /// What the check found.
    pub reason: &'static str,
}

/// A stretch of a segment.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Piece {
    Good {
        range: Range<u64>,
        commit_start: u64,
        entry: Entry,
    },
    Bad {
        range: Range<u64>,
        reason: &'static str,
    },
}

/// Splits a segment into readable records and damaged stretches, in order and without a gap between them.
/// Never panics, whatever the bytes.
pub(crate) fn scan(content: &[u8]) -> Vec<Piece> {
    let mut pieces = Vec::new();
    let mut at = 0;
    while at < content.len() {
        let (end, piece) = match read_frame(content, at) {
            Ok(good) => good,
            Err(reason) => {
                let next = next_frame(content, at);
                let range = at as u64..next as u64;
                (next, Piece::Bad { range, reason })
            }
        };
        pieces.push(piece);
        at = end;
    }
    pieces
}

/// What [`scan`] finds in a segment of `bytes` bytes whose headers are whole, from the headers alone; none where
/// one of them is damaged or the last record is cut off. Payloads of chunks are neither read nor verified.
pub(crate) fn skim(file: &File, bytes: u64) -> io::Result<Option<Vec<Piece>>> {
    let mut pieces = Vec::new();
    let mut window = Window::new(file, bytes);
    let mut at = 0;
    while at < bytes {
        let Ok(header) = record::decode_header(window.at(at, MAX_HEADER_BYTES)?) else {
            return Ok(None);
        };
        let Some(range) = fits(&header, at, bytes) else {
            return Ok(None);
        };
        let payload = if matches!(header.meta, Meta::Snapshot { .. }) {
            window.at(at + header.header_bytes as u64, header.payload_bytes)?
        } else {
            &[]
        };
        let commit_start = header.commit_start;
        let Ok(entry) = header.entry(payload) else {
            return Ok(None);
        };
        at = range.end;
        pieces.push(Piece::Good {
            range,
            commit_start,
            entry,
        });
    }
    Ok(Some(pieces))
}

/// Where a torn tail begins in the segment that was written last; none where nothing is torn.
///
/// A record's group starts at `commit_start`, and a group is only written once everything before it is
/// durable; everything before `durable` is known to be so for another reason. So damage before the newest group
/// is damage; damage inside it is a write that never finished, and nothing of that group behind the damage was
/// ever acknowledged.
pub(crate) fn torn_at(pieces: &[Piece], durable: u64) -> Option<u64> {
    let newest_group = pieces
        .iter()
        .filter_map(|piece| match piece {
            Piece::Good { commit_start, .. } => Some(*commit_start),
            Piece::Bad { .. } => None,
        })
        .max()
        .unwrap_or(0)
        .max(durable);
    pieces.iter().find_map(|piece| match piece {
        Piece::Bad { range, .. } if range.end > newest_group => Some(range.start.max(newest_group)),
        _ => None,
    })
}

/// Notes the missing end of a segment that has `bytes` bytes and is known to have had `end`; false where nothing
/// is missing. A last record that is cut off is one stretch with what is missing behind it.
pub(crate) fn note_missing_end(
    damage: &mut Vec<Quarantined>,
    segment: PathBuf,
    bytes: u64,
    end: u64,
) -> bool {
    if bytes >= end {
        return false;
    }
    let cut_off = damage
        .iter_mut()
        .find(|stretch| stretch.segment == segment && stretch.offset + stretch.bytes == bytes);
    match cut_off {
        Some(stretch) => stretch.bytes = end - stretch.offset,
        None => damage.push(Quarantined {
            segment,
            offset: bytes,
            bytes: end - bytes,
            reason: "its end is missing",
        }),
    }
    true
}

/// Where the frame lies, where its fields can be true in a segment of `bytes` bytes.
fn fits(header: &Header, at: u64, bytes: u64) -> Option<Range<u64>> {
    let end = at + header.frame_bytes() as u64;
    (end <= bytes && header.commit_start <= at).then_some(at..end)
}

fn read_frame(content: &[u8], at: usize) -> Result<(usize, Piece), &'static str> {
    let header = record::decode_header(&content[at..])?;
    let range = fits(&header, at as u64, content.len() as u64)
        .ok_or("its payload is cut off or its commit group starts behind it")?;
    let end = at + header.frame_bytes();
    let payload = &content[at + header.header_bytes..end];
    header.check_payload(payload)?;
    let piece = Piece::Good {
        range,
        commit_start: header.commit_start,
        entry: header.entry(payload)?,
    };
    Ok((end, piece))
}

/// The next offset behind `at` that holds a whole valid record, or the end.
fn next_frame(content: &[u8], at: usize) -> usize {
    let mut from = at + 1;
    while let Some(found) = find_magic(&content[from.min(content.len())..]) {
        let candidate = from + found;
        if read_frame(content, candidate).is_ok() {
            return candidate;
        }
        from = candidate + 1;
    }
    content.len()
}

fn find_magic(bytes: &[u8]) -> Option<usize> {
    bytes
        .windows(MAGIC.len())
        .position(|window| window == MAGIC)
}

/// A stretch of a file in memory, read again where it does not hold what is asked for.
struct Window<'a> {
    file: &'a File,
    /// Length of the file that is looked at.
    bytes: u64,
    start: u64,
    held: Vec<u8>,
}

impl<'a> Window<'a> {
    /// Read ahead: small records share a read, and large ones cost a page.
    const AHEAD: usize = 4096;

    fn new(file: &'a File, bytes: u64) -> Self {
        Self {
            file,
            bytes,
            start: 0,
            held: Vec::new(),
        }
    }

    /// `length` bytes from `at`, fewer at the end of the file.
    fn at(&mut self, at: u64, length: usize) -> io::Result<&[u8]> {
        let left = self.bytes.saturating_sub(at);
        let wanted = left.min(length as u64);
        let held = self.start..self.start + self.held.len() as u64;
        if at < held.start || at + wanted > held.end {
            let ahead = left.min(length.max(Self::AHEAD) as u64);
            self.held.resize(ahead as usize, 0);
            self.start = at;
            self.file.read_exact_at(&mut self.held, at)?;
        }
        let from = (at - self.start) as usize;
        Ok(&self.held[from..from + wanted as usize])
    }
}
