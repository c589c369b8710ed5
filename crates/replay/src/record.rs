//! The binary form of a record in a segment.
//!
//! Frame, little-endian: `magic [u8; 4] | body bytes u32 | commit start u64 | body crc32c u32 | header crc32c
//! u32 | body`. The header has its own checksum so that a damaged body can be stepped over and a damaged
//! header is known as such. `commit start` is the offset in the segment at which the record's commit group
//! began: a group is synced before the next one is written, so one readable record proves that everything
//! before its group was durable. That is what tells a torn tail from damage.
//!
//! Body: `kind u8`, then by kind
//! - chunk: `epoch u64 | seq u64 | episode u64 | first_step u32 | steps u32 | ends u8 | actor | payload`
//! - snapshot: `inserted_steps u64 | count u32 | progress...`, the first record of every segment
//! - progress: `epoch u64 | next_seq u64 | actor`
//!
//! where `actor` is `bytes u16 | UTF-8`.

use bytes::{Buf, BufMut, Bytes};
use isodream_core::Chunk;

use crate::{Progress, ReplayError};

/// Longest actor id, in bytes.
pub const MAX_ACTOR_ID_BYTES: usize = 255;
/// Largest payload of one chunk, in bytes.
pub const MAX_PAYLOAD_BYTES: usize = 32 << 20;

pub(crate) const HEADER_BYTES: usize = 24;
pub(crate) const MAGIC: [u8; 4] = *b"\xd5IR\x01";

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
    /// Every actor's position.
    pub progress: Vec<Progress>,
}

/// A frame's header after its checksum held.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Header {
    pub(crate) body_bytes: usize,
    pub(crate) commit_start: u64,
    body_crc: u32,
}

/// Refuses what the format or the index cannot hold.
pub(crate) fn check(chunk: &Chunk) -> Result<(), ReplayError> {
    let invalid = |reason| {
        Err(ReplayError::InvalidChunk {
            actor_id: chunk.actor_id.chars().take(MAX_ACTOR_ID_BYTES).collect(),
            seq: chunk.seq,
            reason,
        })
    };
    if chunk.actor_id.is_empty() || chunk.actor_id.len() > MAX_ACTOR_ID_BYTES {
        return invalid("its actor id must have 1 to 255 bytes");
    }
    if chunk.steps == 0 {
        return invalid("it holds no steps");
    }
    if chunk.first_step.checked_add(chunk.steps).is_none() {
        return invalid("its step index overflows");
    }
    if chunk.payload.len() > MAX_PAYLOAD_BYTES {
        return invalid("its payload exceeds 32 MiB; send shorter chunks");
    }
    Ok(())
}

/// Appends `record`'s frame to `out`; returns the frame's length in bytes.
///
/// Chunks must have passed [`check`].
pub(crate) fn encode(record: &Record, commit_start: u64, out: &mut Vec<u8>) -> usize {
    let frame_start = out.len();
    out.resize(frame_start + HEADER_BYTES, 0);
    match record {
        Record::Chunk(chunk) => encode_chunk(chunk, out),
        Record::Snapshot(snapshot) => {
            out.put_u8(KIND_SNAPSHOT);
            out.put_u64_le(snapshot.inserted_steps);
            out.put_u32_le(snapshot.progress.len() as u32);
            for progress in &snapshot.progress {
                encode_progress(progress, out);
            }
        }
        Record::Progress(progress) => {
            out.put_u8(KIND_PROGRESS);
            encode_progress(progress, out);
        }
    }
    let body_start = frame_start + HEADER_BYTES;
    let body_bytes = (out.len() - body_start) as u32;
    let body_crc = crc32c::crc32c(&out[body_start..]);
    let mut header = &mut out[frame_start..body_start];
    header.put_slice(&MAGIC);
    header.put_u32_le(body_bytes);
    header.put_u64_le(commit_start);
    header.put_u32_le(body_crc);
    let header_crc = crc32c::crc32c(&out[frame_start..body_start - 4]);
    out[body_start - 4..body_start].copy_from_slice(&header_crc.to_le_bytes());
    out.len() - frame_start
}

fn encode_chunk(chunk: &Chunk, out: &mut Vec<u8>) {
    out.put_u8(KIND_CHUNK);
    out.put_u64_le(chunk.epoch);
    out.put_u64_le(chunk.seq);
    out.put_u64_le(chunk.episode_id);
    out.put_u32_le(chunk.first_step);
    out.put_u32_le(chunk.steps);
    out.put_u8(u8::from(chunk.ends_episode));
    encode_actor(&chunk.actor_id, out);
    out.put_slice(&chunk.payload);
}

fn encode_progress(progress: &Progress, out: &mut Vec<u8>) {
    out.put_u64_le(progress.epoch);
    out.put_u64_le(progress.next_seq);
    encode_actor(&progress.actor_id, out);
}

fn encode_actor(actor_id: &str, out: &mut Vec<u8>) {
    out.put_u16_le(actor_id.len() as u16);
    out.put_slice(actor_id.as_bytes());
}

/// Reads a frame's header from the start of `bytes`.
pub(crate) fn decode_header(bytes: &[u8]) -> Result<Header, &'static str> {
    let header = bytes.get(..HEADER_BYTES).ok_or("its header is cut off")?;
    if header[..4] != MAGIC {
        return Err("it does not start with the record mark");
    }
    let mut fields = &header[4..];
    let body_bytes = fields.get_u32_le() as usize;
    let commit_start = fields.get_u64_le();
    let body_crc = fields.get_u32_le();
    let header_crc = fields.get_u32_le();
    if crc32c::crc32c(&header[..HEADER_BYTES - 4]) != header_crc {
        return Err("its header fails the checksum");
    }
    Ok(Header {
        body_bytes,
        commit_start,
        body_crc,
    })
}

/// Reads a frame's body; `body` is exactly [`Header::body_bytes`] long.
pub(crate) fn decode_body(header: &Header, body: &Bytes) -> Result<Record, &'static str> {
    if body.len() != header.body_bytes || crc32c::crc32c(body) != header.body_crc {
        return Err("its body fails the checksum");
    }
    let mut rest = body.clone();
    let kind = rest.try_get_u8().map_err(|_| SHORT)?;
    let record = match kind {
        KIND_CHUNK => return decode_chunk(rest).map(Record::Chunk),
        KIND_SNAPSHOT => {
            let inserted_steps = rest.try_get_u64_le().map_err(|_| SHORT)?;
            let count = rest.try_get_u32_le().map_err(|_| SHORT)?;
            let progress = (0..count)
                .map(|_| decode_progress(&mut rest))
                .collect::<Result<_, _>>()?;
            Record::Snapshot(Snapshot {
                inserted_steps,
                progress,
            })
        }
        KIND_PROGRESS => Record::Progress(decode_progress(&mut rest)?),
        _ => return Err("its kind is unknown"),
    };
    if rest.has_remaining() {
        return Err("its body has bytes to spare");
    }
    Ok(record)
}

const SHORT: &str = "its body is too short";

fn decode_chunk(mut rest: Bytes) -> Result<Chunk, &'static str> {
    let epoch = rest.try_get_u64_le().map_err(|_| SHORT)?;
    let seq = rest.try_get_u64_le().map_err(|_| SHORT)?;
    let episode_id = rest.try_get_u64_le().map_err(|_| SHORT)?;
    let first_step = rest.try_get_u32_le().map_err(|_| SHORT)?;
    let steps = rest.try_get_u32_le().map_err(|_| SHORT)?;
    let ends_episode = match rest.try_get_u8().map_err(|_| SHORT)? {
        0 => false,
        1 => true,
        _ => return Err("its end flag is neither 0 nor 1"),
    };
    let chunk = Chunk {
        actor_id: decode_actor(&mut rest)?,
        epoch,
        seq,
        episode_id,
        first_step,
        steps,
        ends_episode,
        payload: rest,
    };
    check(&chunk).map_err(|_| "it holds a chunk that cannot be")?;
    Ok(chunk)
}

fn decode_progress(rest: &mut Bytes) -> Result<Progress, &'static str> {
    Ok(Progress {
        epoch: rest.try_get_u64_le().map_err(|_| SHORT)?,
        next_seq: rest.try_get_u64_le().map_err(|_| SHORT)?,
        actor_id: decode_actor(rest)?,
    })
}

fn decode_actor(rest: &mut Bytes) -> Result<String, &'static str> {
    let bytes = usize::from(rest.try_get_u16_le().map_err(|_| SHORT)?);
    if rest.len() < bytes {
        return Err(SHORT);
    }
    String::from_utf8(rest.split_to(bytes).to_vec()).map_err(|_| "its actor id is not UTF-8")
}

#[cfg(test)]
#[path = "record_tests.rs"]
mod tests;
