//! The chunks of a store's folder, read without its lock.

use std::path::Path;
use std::sync::Arc;

use isodream_core::{Chunk, EpisodeId};

use crate::ReplayError;
use crate::inspect::{Depth, good, read};
use crate::record::{ChunkMeta, Entry};
use crate::scan::Piece;
use crate::segment::{ChunkRef, Segment};

/// Reads every chunk that the folder holds, in the order in which they were stored, those of evicted episodes that
/// are not yet deleted among them.
///
/// # Errors
/// As [`find_chunk`], and the first error of `visit`.
pub fn for_each_chunk<E: From<ReplayError>>(
    folder: &Path,
    mut visit: impl FnMut(Chunk) -> Result<(), E>,
) -> Result<(), E> {
    let mut places = Vec::new();
    read(folder, Depth::Headers, &mut |segment, _, pieces| {
        places.extend(chunks(segment, &pieces).map(|(_, place)| place));
        Ok(())
    })?;
    places.iter().try_for_each(|place| visit(place.read()?))
}

/// The chunk that holds `step` of `episode_id`; none where the store does not.
///
/// # Errors
/// As [`inspect`](crate::inspect()), and [`ReplayError::Damaged`] where the chunk is there but cannot be read.
pub fn find_chunk(
    folder: &Path,
    episode_id: EpisodeId,
    step: u32,
) -> Result<Option<Chunk>, ReplayError> {
    let mut found = None;
    read(folder, Depth::Headers, &mut |segment, _, pieces| {
        for (chunk, place) in chunks(segment, &pieces) {
            if chunk.episode_id == episode_id
                && (chunk.first_step..chunk.first_step + chunk.steps).contains(&step)
            {
                found = Some(place.read()?);
            }
        }
        Ok(())
    })?;
    Ok(found)
}

/// The chunks among `pieces`, and where to read them.
fn chunks<'a>(
    segment: &'a Arc<Segment>,
    pieces: &'a [Piece],
) -> impl Iterator<Item = (&'a ChunkMeta, ChunkRef)> {
    good(pieces).filter_map(|(range, entry)| {
        let Entry::Chunk(chunk) = entry else {
            return None;
        };
        let place = ChunkRef {
            segment: segment.clone(),
            offset: range.start,
            frame_bytes: (range.end - range.start) as u32,
            first_step: chunk.first_step,
            steps: chunk.steps,
        };
        Some((chunk, place))
    })
}
