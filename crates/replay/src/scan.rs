//! Reading a whole segment of unknown health.

use std::ops::Range;
use std::path::PathBuf;

use bytes::Bytes;

use crate::record::{self, HEADER_BYTES, MAGIC, Record};

/// A damaged stretch that was skipped.
#[derive(Debug, Clone, PartialEq, Eq)]
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
        range: Range<usize>,
        commit_start: usize,
        record: Record,
    },
    Bad {
        range: Range<usize>,
        reason: &'static str,
    },
}

/// Splits a segment into readable records and damaged stretches, in order and without a gap between them.
/// Never panics, whatever the bytes.
pub(crate) fn scan(content: &Bytes) -> Vec<Piece> {
    let mut pieces = Vec::new();
    let mut at = 0;
    while at < content.len() {
        match read_frame(content, at) {
            Ok(piece) => {
                at = end_of(&piece);
                pieces.push(piece);
            }
            Err(reason) => {
                let next = next_frame(content, at);
                pieces.push(Piece::Bad {
                    range: at..next,
                    reason,
                });
                at = next;
            }
        }
    }
    pieces
}

/// Where a torn tail begins in the segment that was written last; its length where nothing is torn.
///
/// A record's group starts at `commit_start`, and a group is only written once everything before it is
/// durable. So damage before the newest group is damage; damage inside it is a write that never finished, and
/// nothing of that group behind the damage was ever acknowledged.
pub(crate) fn torn_at(pieces: &[Piece]) -> Option<usize> {
    let newest_group = pieces
        .iter()
        .filter_map(|piece| match piece {
            Piece::Good { commit_start, .. } => Some(*commit_start),
            Piece::Bad { .. } => None,
        })
        .max()
        .unwrap_or(0);
    pieces.iter().find_map(|piece| match piece {
        Piece::Bad { range, .. } if range.end > newest_group => Some(range.start.max(newest_group)),
        _ => None,
    })
}

fn end_of(piece: &Piece) -> usize {
    match piece {
        Piece::Good { range, .. } | Piece::Bad { range, .. } => range.end,
    }
}

fn read_frame(content: &Bytes, at: usize) -> Result<Piece, &'static str> {
    let header = record::decode_header(&content[at..])?;
    let body_start = at + HEADER_BYTES;
    let body_end = body_start
        .checked_add(header.body_bytes)
        .filter(|end| *end <= content.len())
        .ok_or("its body is cut off")?;
    let commit_start = usize::try_from(header.commit_start)
        .ok()
        .filter(|start| *start <= at)
        .ok_or("its commit group starts behind it")?;
    let record = record::decode_body(&header, &content.slice(body_start..body_end))?;
    Ok(Piece::Good {
        range: at..body_end,
        commit_start,
        record,
    })
}

/// The next offset behind `at` that holds a whole valid record, or the end.
fn next_frame(content: &Bytes, at: usize) -> usize {
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
