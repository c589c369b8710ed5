//! The binary form of a record in a segment.
//!
//! Frame, little-endian: `magic [u8; 4] | metadata bytes u16 | payload bytes u32 | commit start u64 | payload
//! crc32c u32 | header crc32c u32 | metadata | payload`. The header's checksum covers everything before the
//! payload but itself, so that opening a store needs the headers alone, and so that a damaged payload can be
//! stepped over. `commit start` is the offset in the segment at which the record's commit group began: a group
//! is synced before the next one is written, so one readable record proves that everything before its group was
//! durable. That is what tells a torn tail from damage.
//!
//! Metadata: `kind u8`, then by kind
//! - chunk: `epoch u64 | seq u64 | episode u64 | first_step u32 | steps u32 | ends u8 | actor`; the payload is
//!   the chunk's own
//! - snapshot: `inserted_steps u64 | closed segment u64 | closed bytes u64`, the first record of every segment;
//!   the payload is a list of `epoch u64 | next_seq u64 | actor bytes u8 | actor`
//! - progress: `epoch u64 | next_seq u64 | actor`, without payload
//!
//! where `actor` is UTF-8 up to the end of the metadata.

use bytes::{Buf, BufMut, Bytes};
use isodream_core::{Chunk, EpisodeId};

use crate::{LogPosition, Progress, ReplayError};

/// Longest actor id, in bytes.
pub const MAX_ACTOR_ID_BYTES: usize = 255;
/// What epochs and sequence numbers stay below. They count microseconds and chunks: nobody comes there by counting.
const NUMBER_LIMIT: u64 = 1 << 62;
/// Largest payload of one chunk, in bytes.
pub const MAX_PAYLOAD_BYTES: usize = 32 << 20;

pub(crate) const MAGIC: [u8; 4] = *b"\xd5IR\x02";
/// Bytes of a header before its metadata.
const FIXED_BYTES: usize = 26;
const CRC_AT: usize = FIXED_BYTES - 4;
/// Longest header, in bytes: a chunk's with the longest actor id.
pub(crate) const MAX_HEADER_BYTES: usize = FIXED_BYTES + 34 + MAX_ACTOR_ID_BYTES;

const KIND_CHUNK: u8 = 1;
const KIND_SNAPSHOT: u8 = 2;
const KIND_PROGRESS: u8 = 3;

/// What a segment holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Record {
    /// Experience.
    Chunk(Chunk),
    /// What earlier segments amount to, so that they can be deleted.
    Snapshot(Snapshot),
    /// An actor's epoch or position changed without a chunk.
    Progress(Progress),
}

/// The state that must outlive the segments that made it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Snapshot {
    /// Steps inserted since the store was made.
    pub inserted_steps: u64,
    /// The end of the segment that was closed before this one was begun; segment 0 where there was none.
    pub closed: LogPosition,
    /// Every actor's position.
    pub progress: Vec<Progress>,
}

/// A chunk without its payload.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ChunkMeta {
    pub(crate) actor_id: String,
    pub(crate) epoch: u64,
    pub(crate) seq: u64,
    pub(crate) episode_id: EpisodeId,
    pub(crate) first_step: u32,
    pub(crate) steps: u32,
    pub(crate) ends_episode: bool,
}

/// What a header says of its record.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Meta {
    Chunk(ChunkMeta),
    Snapshot {
        inserted_steps: u64,
        closed: LogPosition,
    },
    Progress(Progress),
}

/// A frame's header after its checksum held.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Header {
    pub(crate) header_bytes: usize,
    pub(crate) payload_bytes: usize,
    pub(crate) commit_start: u64,
    pub(crate) meta: Meta,
    payload_crc: u32,
}

impl Header {
    pub(crate) fn frame_bytes(&self) -> usize {
        self.header_bytes + self.payload_bytes
    }

    /// Verifies a payload of exactly [`Header::payload_bytes`].
    pub(crate) fn check_payload(&self, payload: &[u8]) -> Result<(), &'static str> {
        if payload.len() == self.payload_bytes && crc32c::crc32c(payload) == self.payload_crc {
            return Ok(());
        }
        Err("its payload fails the checksum")
    }

    /// The record but for a chunk's payload, which is not looked at; what else has a payload is verified.
    pub(crate) fn entry(self, payload: &[u8]) -> Result<Entry, &'static str> {
        Ok(match self.meta {
            Meta::Chunk(meta) => Entry::Chunk(meta),
            Meta::Snapshot {
                inserted_steps,
                closed,
            } => {
                self.check_payload(payload)?;
                Entry::Snapshot(Snapshot {
                    inserted_steps,
                    closed,
                    progress: decode_positions(payload)?,
                })
            }
            Meta::Progress(progress) => Entry::Progress(progress),
        })
    }
}

/// A record without the payload of a chunk.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Entry {
    Chunk(ChunkMeta),
    Snapshot(Snapshot),
    Progress(Progress),
}

/// Refuses what the format or the index cannot hold.
pub(crate) fn check(chunk: &Chunk) -> Result<(), ReplayError> {
    check_position(&chunk.actor_id, chunk.epoch, chunk.seq)?;
    let reason = why_not(
        &chunk.actor_id,
        chunk.first_step,
        chunk.steps,
        chunk.payload.len(),
    );
    reason.map_or(Ok(()), |reason| {
        Err(invalid(&chunk.actor_id, chunk.seq, reason))
    })
}

/// Refuses an actor's id, an epoch or a sequence number that cannot be stored.
pub(crate) fn check_position(actor_id: &str, epoch: u64, seq: u64) -> Result<(), ReplayError> {
    if let Some(reason) = why_no_actor(actor_id) {
        return Err(invalid(actor_id, seq, reason));
    }
    if epoch >= NUMBER_LIMIT || seq >= NUMBER_LIMIT {
        return Err(invalid(
            actor_id,
            seq,
            "its epoch or its sequence number is beyond all counting",
        ));
    }
    Ok(())
}

fn invalid(actor_id: &str, seq: u64, reason: &'static str) -> ReplayError {
    ReplayError::InvalidChunk {
        actor_id: actor_id.chars().take(MAX_ACTOR_ID_BYTES).collect(),
        seq,
        reason,
    }
}

fn why_no_actor(actor_id: &str) -> Option<&'static str> {
    let fits = (1..=MAX_ACTOR_ID_BYTES).contains(&actor_id.len());
    (!fits).then_some("its actor id must have 1 to 255 bytes")
}

fn why_not(
    actor_id: &str,
    first_step: u32,
    steps: u32,
    payload_bytes: usize,
) -> Option<&'static str> {
    if let Some(reason) = why_no_actor(actor_id) {
        Some(reason)
    } else if steps == 0 {
        Some("it holds no steps")
    } else if first_step.checked_add(steps).is_none() {
        Some("its step index overflows")
    } else if payload_bytes > MAX_PAYLOAD_BYTES {
        Some("its payload exceeds 32 MiB; send shorter chunks")
    } else {
        None
    }
}

/// Appends `record`'s frame to `out`; returns the frame's length in bytes.
///
/// Chunks must have passed [`check`].
pub(crate) fn encode(record: &Record, commit_start: u64, out: &mut Vec<u8>) -> usize {
    let frame_start = out.len();
    out.resize(frame_start + FIXED_BYTES, 0);
    let payload_start = match record {
        Record::Chunk(chunk) => {
            out.reserve(MAX_HEADER_BYTES + chunk.payload.len());
            out.put_u8(KIND_CHUNK);
            out.put_u64_le(chunk.epoch);
            out.put_u64_le(chunk.seq);
            out.put_u64_le(chunk.episode_id);
            out.put_u32_le(chunk.first_step);
            out.put_u32_le(chunk.steps);
            out.put_u8(u8::from(chunk.ends_episode));
            out.put_slice(chunk.actor_id.as_bytes());
            let payload_start = out.len();
            out.put_slice(&chunk.payload);
            payload_start
        }
        Record::Snapshot(snapshot) => {
            out.put_u8(KIND_SNAPSHOT);
            out.put_u64_le(snapshot.inserted_steps);
            out.put_u64_le(snapshot.closed.segment);
            out.put_u64_le(snapshot.closed.offset);
            let payload_start = out.len();
            for position in &snapshot.progress {
                out.put_u64_le(position.epoch);
                out.put_u64_le(position.next_seq);
                out.put_u8(position.actor_id.len() as u8);
                out.put_slice(position.actor_id.as_bytes());
            }
            payload_start
        }
        Record::Progress(progress) => {
            out.put_u8(KIND_PROGRESS);
            out.put_u64_le(progress.epoch);
            out.put_u64_le(progress.next_seq);
            out.put_slice(progress.actor_id.as_bytes());
            out.len()
        }
    };
    let frame = &mut out[frame_start..];
    let (head, payload) = frame.split_at_mut(payload_start - frame_start);
    let metadata_bytes = (head.len() - FIXED_BYTES) as u16;
    let mut fixed = &mut head[..CRC_AT];
    fixed.put_slice(&MAGIC);
    fixed.put_u16_le(metadata_bytes);
    fixed.put_u32_le(payload.len() as u32);
    fixed.put_u64_le(commit_start);
    fixed.put_u32_le(crc32c::crc32c(payload));
    let crc = header_crc(head);
    head[CRC_AT..FIXED_BYTES].copy_from_slice(&crc.to_le_bytes());
    frame.len()
}

fn header_crc(header: &[u8]) -> u32 {
    crc32c::crc32c_append(crc32c::crc32c(&header[..CRC_AT]), &header[FIXED_BYTES..])
}

/// Reads a frame's header from the start of `bytes`; at most [`MAX_HEADER_BYTES`] are looked at.
pub(crate) fn decode_header(bytes: &[u8]) -> Result<Header, &'static str> {
    const CUT_OFF: &str = "its header is cut off";
    let mut fixed = bytes.get(..FIXED_BYTES).ok_or(CUT_OFF)?;
    if fixed[..4] != MAGIC {
        return Err("it does not start with the record mark");
    }
    fixed.advance(4);
    let header_bytes = FIXED_BYTES + usize::from(fixed.get_u16_le());
    let payload_bytes = fixed.get_u32_le() as usize;
    let commit_start = fixed.get_u64_le();
    let payload_crc = fixed.get_u32_le();
    let crc = fixed.get_u32_le();
    if header_bytes > MAX_HEADER_BYTES {
        return Err("its header fails the checksum");
    }
    let header = bytes.get(..header_bytes).ok_or(CUT_OFF)?;
    if header_crc(header) != crc {
        return Err("its header fails the checksum");
    }
    Ok(Header {
        header_bytes,
        payload_bytes,
        commit_start,
        meta: decode_meta(&header[FIXED_BYTES..], payload_bytes)?,
        payload_crc,
    })
}

/// Reads the frame of a chunk, of exactly the length of `frame`.
pub(crate) fn decode_chunk(frame: &Bytes) -> Result<Chunk, &'static str> {
    let header = decode_header(frame)?;
    let payload = frame.slice(header.header_bytes..);
    header.check_payload(&payload)?;
    let Meta::Chunk(meta) = header.meta else {
        return Err("it is not a chunk");
    };
    Ok(Chunk {
        actor_id: meta.actor_id,
        epoch: meta.epoch,
        seq: meta.seq,
        episode_id: meta.episode_id,
        first_step: meta.first_step,
        steps: meta.steps,
        ends_episode: meta.ends_episode,
        payload,
    })
}

const SHORT: &str = "its metadata is too short";

fn decode_meta(mut meta: &[u8], payload_bytes: usize) -> Result<Meta, &'static str> {
    let kind = meta.try_get_u8().map_err(|_| SHORT)?;
    if kind == KIND_PROGRESS && payload_bytes > 0 {
        return Err("it has a payload that it should not have");
    }
    match kind {
        KIND_CHUNK => decode_chunk_meta(meta, payload_bytes).map(Meta::Chunk),
        KIND_SNAPSHOT => {
            let inserted_steps = meta.try_get_u64_le().map_err(|_| SHORT)?;
            let segment = meta.try_get_u64_le().map_err(|_| SHORT)?;
            let offset = meta.try_get_u64_le().map_err(|_| SHORT)?;
            if meta.has_remaining() {
                return Err("its metadata has bytes to spare");
            }
            Ok(Meta::Snapshot {
                inserted_steps,
                closed: LogPosition { segment, offset },
            })
        }
        KIND_PROGRESS => Ok(Meta::Progress(Progress {
            epoch: meta.try_get_u64_le().map_err(|_| SHORT)?,
            next_seq: meta.try_get_u64_le().map_err(|_| SHORT)?,
            actor_id: decode_actor(meta)?,
        })),
        _ => Err("its kind is unknown"),
    }
}

fn decode_chunk_meta(mut meta: &[u8], payload_bytes: usize) -> Result<ChunkMeta, &'static str> {
    let epoch = meta.try_get_u64_le().map_err(|_| SHORT)?;
    let seq = meta.try_get_u64_le().map_err(|_| SHORT)?;
    let episode_id = meta.try_get_u64_le().map_err(|_| SHORT)?;
    let first_step = meta.try_get_u32_le().map_err(|_| SHORT)?;
    let steps = meta.try_get_u32_le().map_err(|_| SHORT)?;
    let ends_episode = match meta.try_get_u8().map_err(|_| SHORT)? {
        0 => false,
        1 => true,
        _ => return Err("its end flag is neither 0 nor 1"),
    };
    let actor_id = decode_actor(meta)?;
    if let Some(reason) = why_not(&actor_id, first_step, steps, payload_bytes) {
        return Err(reason);
    }
    Ok(ChunkMeta {
        actor_id,
        epoch,
        seq,
        episode_id,
        first_step,
        steps,
        ends_episode,
    })
}

fn decode_positions(mut payload: &[u8]) -> Result<Vec<Progress>, &'static str> {
    const SHORT: &str = "its payload is too short";
    let mut positions = Vec::new();
    while payload.has_remaining() {
        let epoch = payload.try_get_u64_le().map_err(|_| SHORT)?;
        let next_seq = payload.try_get_u64_le().map_err(|_| SHORT)?;
        let bytes = usize::from(payload.try_get_u8().map_err(|_| SHORT)?);
        let (actor_id, rest) = payload.split_at_checked(bytes).ok_or(SHORT)?;
        payload = rest;
        positions.push(Progress {
            actor_id: decode_actor(actor_id)?,
            epoch,
            next_seq,
        });
    }
    Ok(positions)
}

fn decode_actor(bytes: &[u8]) -> Result<String, &'static str> {
    let actor_id = str::from_utf8(bytes).map_err(|_| "its actor id is not UTF-8")?;
    Ok(actor_id.to_owned())
}

#[cfg(test)]
#[path = "record_tests.rs"]
mod tests;
