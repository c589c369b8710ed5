//! One block of images: LZ4, or as it is where that saves nothing.

use lz4::block::{CompressionMode, compress_bound, compress_to_buffer, decompress_to_buffer};

/// Marks a block that is stored as it is.
const RAW: u32 = 1 << 31;

/// Searches less than LZ4's default of 1: a tenth larger, a fifth faster to pack, and faster to unpack.
const MODE: CompressionMode = CompressionMode::FAST(4);

/// Packs blocks through a buffer of its own.
pub(super) struct Packer {
    buffer: Vec<u8>,
}

impl Packer {
    /// For blocks of at most `bytes`.
    ///
    /// # Panics
    /// If a block has more than 2 GB.
    pub(super) fn new(bytes: usize) -> Self {
        let bound = compress_bound(bytes).expect("a block of images has less than 2 GB");
        Self {
            buffer: vec![0; bound],
        }
    }

    /// Appends `images` to `out`; returns what the table says of the block.
    pub(super) fn pack(&mut self, images: &[u8], out: &mut Vec<u8>) -> u32 {
        let packed = compress_to_buffer(images, Some(MODE), false, &mut self.buffer);
        // Less than a sixteenth is not worth decoding. A buffer of the bound's size cannot be too small.
        match packed {
            Ok(bytes) if bytes < images.len() - images.len() / 16 => {
                out.extend_from_slice(&self.buffer[..bytes]);
                bytes as u32
            }
            _ => {
                out.extend_from_slice(images);
                images.len() as u32 | RAW
            }
        }
    }
}

/// Bytes that a block takes in the payload, by its entry in the table.
pub(super) fn stored_bytes(entry: u32) -> usize {
    (entry & !RAW) as usize
}

/// Unpacks a block into exactly as many bytes as its images have.
pub(super) fn unpack(entry: u32, stored: &[u8], images: &mut [u8]) -> Result<(), String> {
    let found = if entry & RAW != 0 {
        if stored.len() == images.len() {
            images.copy_from_slice(stored);
        }
        stored.len()
    } else {
        let most = i32::try_from(images.len()).map_err(|error| error.to_string())?;
        decompress_to_buffer(stored, Some(most), images).map_err(|error| error.to_string())?
    };
    if found != images.len() {
        return Err(format!("{found} bytes where {} belong", images.len()));
    }
    Ok(())
}
