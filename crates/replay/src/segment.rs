//! One segment file and references into it.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use isodream_core::Chunk;
use rustix::buffer::spare_capacity;
use rustix::io::{Errno, pread};

use crate::ReplayError;
use crate::record;

const PREFIX: &str = "segment-";
const SUFFIX: &str = ".log";

/// An open segment. A reference keeps it readable even after the file was deleted by eviction.
#[derive(Debug)]
pub(crate) struct Segment {
    pub(crate) number: u64,
    pub(crate) path: PathBuf,
    pub(crate) file: File,
}

impl Segment {
    pub(crate) fn path_of(folder: &Path, number: u64) -> PathBuf {
        folder.join(format!("{PREFIX}{number:020}{SUFFIX}"))
    }

    /// The number in a segment's file name; none for other files.
    pub(crate) fn number_of(name: &str) -> Option<u64> {
        name.strip_prefix(PREFIX)?
            .strip_suffix(SUFFIX)?
            .parse()
            .ok()
    }
}

/// A stored chunk: where it lies and which steps it holds.
#[derive(Debug, Clone)]
pub struct ChunkRef {
    pub(crate) segment: Arc<Segment>,
    pub(crate) offset: u64,
    pub(crate) frame_bytes: u32,
    pub(crate) first_step: u32,
    pub(crate) steps: u32,
}

impl ChunkRef {
    /// Number of the segment.
    pub fn segment(&self) -> u64 {
        self.segment.number
    }

    /// Byte offset of the record in the segment.
    pub fn offset(&self) -> u64 {
        self.offset
    }

    /// Bytes the record takes on disk.
    pub fn stored_bytes(&self) -> u64 {
        u64::from(self.frame_bytes)
    }

    /// Index within the episode of the chunk's first step.
    pub fn first_step(&self) -> u32 {
        self.first_step
    }

    /// Steps the chunk holds.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    /// Reads the chunk and verifies its checksums. Blocks on the disk, takes no lock.
    ///
    /// # Errors
    /// [`ReplayError::Damaged`] where a checksum fails, [`ReplayError::Io`] where the disk does.
    pub fn read(&self) -> Result<Chunk, ReplayError> {
        let damaged = |reason| ReplayError::Damaged {
            path: self.segment.path.clone(),
            offset: self.offset,
            reason,
        };
        let frame = self.read_frame().map_err(|error| match error.kind() {
            io::ErrorKind::UnexpectedEof => damaged("its end is missing"),
            _ => ReplayError::io("read", &self.segment.path)(error),
        })?;
        record::decode_chunk(&Bytes::from(frame)).map_err(damaged)
    }

    /// The record's bytes, in memory that is not cleared first.
    fn read_frame(&self) -> io::Result<Vec<u8>> {
        let bytes = self.frame_bytes as usize;
        let mut frame = Vec::with_capacity(bytes);
        while frame.len() < bytes {
            let next = self.offset + frame.len() as u64;
            match pread(&self.segment.file, spare_capacity(&mut frame), next) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(_) | Err(Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
        }
        // The allocator may have given more room than was asked for.
        frame.truncate(bytes);
        Ok(frame)
    }
}
