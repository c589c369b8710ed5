//! Looking into a store's folder without its lock, also while a server writes to it.
//!
//! What a writer is just adding to the newest segment is reported as its unfinished tail, and a segment that is
//! evicted meanwhile is left out.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use isodream_core::EpisodeId;
use serde::Serialize;

use crate::folder::{self, StoreIdentity};
use crate::ledger::Ledger;
use crate::record::Entry;
use crate::recover::{list_segments, read_whole};
use crate::scan::{self, Piece, Quarantined};
use crate::segment::Segment;
use crate::{LogPosition, Progress, ReplayError};

/// What [`inspect`] found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Inspection {
    /// The folder's format.
    pub format: &'static str,
    /// What the store belongs to; none before its first handshake.
    pub identity: Option<StoreIdentity>,
    /// The segments in order.
    pub segments: Vec<SegmentSummary>,
    /// The episodes in the segments, those among them that are evicted but not yet deleted.
    pub episodes: EpisodeSummary,
    /// Every actor's newest epoch and the next sequence number of it.
    pub actors: Vec<Progress>,
    /// Steps inserted since the store was made.
    pub inserted_steps: u64,
    /// Damaged stretches; of payloads only those in segments with a damaged header and in the newest segment.
    pub damage: Vec<Quarantined>,
    /// Bytes at the end of the newest segment that belong to no finished write.
    pub unfinished_bytes: u64,
}

/// One segment.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SegmentSummary {
    /// The file.
    pub path: PathBuf,
    /// Its length in bytes.
    pub bytes: u64,
    /// Readable records.
    pub records: u64,
    /// Steps in the chunks among them.
    pub steps: u64,
}

/// Episodes by the chunks that are there.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct EpisodeSummary {
    /// Episodes with at least one step.
    pub count: u64,
    /// Those from their first step to their last, without a hole.
    pub complete: u64,
    /// Steps of all.
    pub steps: u64,
    /// Steps of the shortest.
    pub shortest: u64,
    /// Steps of the longest.
    pub longest: u64,
    /// The one that was written to last.
    pub newest: Option<EpisodeId>,
}

/// What [`verify`] found.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Verification {
    /// Segments read.
    pub segments: u64,
    /// Bytes read.
    pub bytes: u64,
    /// Records whose checksums hold.
    pub records: u64,
    /// Everything else: where, how much and why.
    pub damage: Vec<Quarantined>,
    /// Bytes at the end of the newest segment that belong to no finished write.
    pub unfinished_bytes: u64,
}

/// Sums up what a folder holds, from the headers of its closed segments and all of its newest one.
///
/// # Errors
/// [`ReplayError`] where the folder has another format or cannot be read.
pub fn inspect(folder: &Path) -> Result<Inspection, ReplayError> {
    let mut ledger = Ledger::default();
    let mut inserted_steps = 0;
    let mut episodes: BTreeMap<EpisodeId, Episode> = BTreeMap::new();
    let mut newest = None;
    let mut segments = Vec::new();
    let tail = read(folder, Depth::Headers, &mut |segment, bytes, pieces| {
        let mut summary = SegmentSummary {
            path: segment.path.clone(),
            bytes,
            records: 0,
            steps: 0,
        };
        for (_, entry) in good(&pieces) {
            summary.records += 1;
            match entry {
                Entry::Chunk(chunk) => {
                    let steps = u64::from(chunk.steps);
                    summary.steps += steps;
                    inserted_steps += steps;
                    newest = Some(chunk.episode_id);
                    ledger.recover(&chunk.actor_id, chunk.epoch, chunk.seq.saturating_add(1));
                    let episode = episodes.entry(chunk.episode_id).or_default();
                    episode.whole &= u64::from(chunk.first_step) == episode.steps;
                    episode.steps += steps;
                    episode.ended |= chunk.ends_episode;
                }
                Entry::Snapshot(snapshot) => {
                    inserted_steps = inserted_steps.max(snapshot.inserted_steps);
                    for position in &snapshot.progress {
                        ledger.recover(&position.actor_id, position.epoch, position.next_seq);
                    }
                }
                Entry::Progress(position) => {
                    ledger.recover(&position.actor_id, position.epoch, position.next_seq);
                }
            }
        }
        segments.push(summary);
        Ok(())
    })?;
    Ok(Inspection {
        format: folder::FORMAT,
        identity: folder::read_identity(folder)?,
        segments,
        episodes: EpisodeSummary {
            count: episodes.len() as u64,
            complete: episodes
                .values()
                .filter(|episode| episode.whole && episode.ended)
                .count() as u64,
            steps: episodes.values().map(|episode| episode.steps).sum(),
            shortest: lengths(&episodes).min().unwrap_or(0),
            longest: lengths(&episodes).max().unwrap_or(0),
            newest,
        },
        actors: ledger.progress(),
        inserted_steps,
        damage: tail.damage,
        unfinished_bytes: tail.unfinished_bytes,
    })
}

/// Checks every checksum of every byte.
///
/// # Errors
/// [`ReplayError`] where the folder has another format or cannot be read. Damage is no error.
pub fn verify(folder: &Path) -> Result<Verification, ReplayError> {
    let mut report = Verification::default();
    let tail = read(folder, Depth::Everything, &mut |_, bytes, pieces| {
        report.segments += 1;
        report.bytes += bytes;
        report.records += good(&pieces).count() as u64;
        Ok(())
    })?;
    report.damage = tail.damage;
    report.unfinished_bytes = tail.unfinished_bytes;
    Ok(report)
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Depth {
    /// Payloads of closed segments are not looked at.
    Headers,
    Everything,
}

struct Episode {
    steps: u64,
    whole: bool,
    ended: bool,
}

impl Default for Episode {
    fn default() -> Self {
        Self {
            steps: 0,
            whole: true,
            ended: false,
        }
    }
}

fn lengths(episodes: &BTreeMap<EpisodeId, Episode>) -> impl Iterator<Item = u64> {
    episodes.values().map(|episode| episode.steps)
}

pub(crate) fn good(pieces: &[Piece]) -> impl Iterator<Item = (&std::ops::Range<u64>, &Entry)> {
    pieces.iter().filter_map(|piece| match piece {
        Piece::Good { range, entry, .. } => Some((range, entry)),
        Piece::Bad { .. } => None,
    })
}

#[derive(Default)]
pub(crate) struct Tail {
    damage: Vec<Quarantined>,
    unfinished_bytes: u64,
}

/// Takes every segment with its length in bytes and what is in it.
pub(crate) type Visit<'a> =
    dyn FnMut(&Arc<Segment>, u64, Vec<Piece>) -> Result<(), ReplayError> + 'a;

/// Reads the segments one after the other.
pub(crate) fn read(
    folder: &Path,
    depth: Depth,
    visit: &mut Visit<'_>,
) -> Result<Tail, ReplayError> {
    folder::read_format(folder)?;
    // Before the segments: what is durable at this moment is in them.
    let durable = folder::read_durable(folder)?;
    let numbers = list_segments(folder)?;
    let last = numbers.last().copied();
    let mut tail = Tail::default();
    let mut lengths = BTreeMap::new();
    for number in numbers {
        let path = Segment::path_of(folder, number);
        let file = match File::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            Err(error) => return Err(ReplayError::io("open", &path)(error)),
        };
        let metadata = file.metadata();
        let mut bytes = metadata.map_err(ReplayError::io("look at", &path))?.len();
        lengths.insert(number, bytes);
        let skimmed = if depth == Depth::Headers && Some(number) != last {
            scan::skim(&file, bytes).map_err(ReplayError::io("read", &path))?
        } else {
            None
        };
        let mut pieces = match skimmed {
            Some(pieces) => pieces,
            None => scan::scan(&read_whole(&file, bytes, &path)?),
        };
        if Some(number) == last {
            let known = if durable.segment == number {
                durable.offset
            } else {
                0
            };
            let end = scan::torn_at(&pieces, known.min(bytes)).unwrap_or(bytes);
            tail.unfinished_bytes = bytes - end;
            bytes = end;
            pieces.retain(|piece| {
                let (Piece::Good { range, .. } | Piece::Bad { range, .. }) = piece;
                range.start < end
            });
        }
        let segment = Arc::new(Segment { number, path, file });
        for piece in &pieces {
            match piece {
                Piece::Bad { range, reason } => tail.damage.push(Quarantined {
                    segment: segment.path.clone(),
                    offset: range.start,
                    bytes: range.end.min(bytes) - range.start,
                    reason,
                }),
                Piece::Good {
                    entry: Entry::Snapshot(snapshot),
                    ..
                } => tail.note_missing_end(folder, &lengths, snapshot.closed),
                Piece::Good { .. } => {}
            }
        }
        visit(&segment, bytes, pieces)?;
    }
    tail.note_missing_end(folder, &lengths, durable);
    Ok(tail)
}

impl Tail {
    fn note_missing_end(&mut self, folder: &Path, lengths: &BTreeMap<u64, u64>, end: LogPosition) {
        if let Some(&bytes) = lengths.get(&end.segment) {
            let path = Segment::path_of(folder, end.segment);
            scan::note_missing_end(&mut self.damage, path, bytes, end.offset);
        }
    }
}
