//! The encoding of a chunk's payload: small columns as they are, images in blocks that LZ4 compresses one by one,
//! so that a reader of some steps decodes the blocks of these steps only.
//!
//! Layout, little-endian: `steps u32 | image_bytes u32 | action_dim u32 | block_steps u32 | actions | rewards |
//! discounts | flags | stored bytes of each block u32 | blocks`. Each block holds the images of `block_steps` steps,
//! the last one of what is left. The top bit of its stored bytes tells that it holds them as they are, which is how
//! noise is kept. All sizes follow from the header and are capped before memory is taken, so a forged payload
//! cannot ask for more than [`MAX_DECODED_BYTES`].
//!
//! LZ4, the number of images per block and the lack of a delta between them were measured: `docs/performance.md`,
//! "Frames, compressed".

mod block;
mod error;
mod payload;

use bytes::{BufMut, Bytes};

pub use self::error::DecodeError;
pub use self::payload::{Decoder, Payload, Rows};
use crate::Steps;

/// The most bytes one payload may decode to.
pub const MAX_DECODED_BYTES: usize = 64 << 20;

/// Bytes of images in a block, about: eight of 64 x 64 x 3. A block is a whole number of images, at least one.
const BLOCK_BYTES: usize = 96 << 10;

const HEADER_BYTES: usize = 16;

/// Encodes `steps`.
///
/// # Panics
/// If the images of a block have more than 2 GB: no decoder would take them.
pub fn encode(steps: &Steps) -> Bytes {
    let block_steps = block_steps(steps.len, steps.image_bytes);
    let blocks = steps.len.div_ceil(block_steps);
    let small = steps.len * (4 * steps.action_dim + 9) + 4 * blocks;
    let mut out = Vec::with_capacity(HEADER_BYTES + small + steps.images.len() / 2);
    for size in [steps.len, steps.image_bytes, steps.action_dim, block_steps] {
        out.put_u32_le(size as u32);
    }
    let floats = [&steps.actions, &steps.rewards, &steps.discounts];
    for value in floats.into_iter().flatten() {
        out.put_f32_le(*value);
    }
    out.put_slice(&steps.flags);
    let mut table = out.len();
    out.resize(table + 4 * blocks, 0);
    let mut packer = block::Packer::new(block_steps * steps.image_bytes);
    let block_bytes = (block_steps * steps.image_bytes).max(1);
    let mut images = steps.images.chunks(block_bytes);
    for _ in 0..blocks {
        let stored = packer.pack(images.next().unwrap_or_default(), &mut out);
        out[table..table + 4].copy_from_slice(&stored.to_le_bytes());
        table += 4;
    }
    out.into()
}

/// Decodes all of what [`encode`] made. [`Decoder`] decodes a part, into memory that is there.
///
/// # Errors
/// [`DecodeError`] on any payload that `encode` cannot have made; never panics, never takes more memory
/// than the cap.
pub fn decode(payload: &[u8]) -> Result<Steps, DecodeError> {
    let payload = Payload::parse(payload)?;
    let len = payload.steps();
    let mut steps = Steps {
        len,
        image_bytes: payload.image_bytes(),
        action_dim: payload.action_dim(),
        images: vec![0; len * payload.image_bytes()],
        actions: vec![0.0; len * payload.action_dim()],
        rewards: vec![0.0; len],
        discounts: vec![0.0; len],
        flags: payload.flags().to_vec(),
    };
    let rows = Rows {
        images: &mut steps.images,
        actions: &mut steps.actions,
        rewards: &mut steps.rewards,
        discounts: &mut steps.discounts,
    };
    Decoder::default().decode_into(&payload, 0..len, rows)?;
    Ok(steps)
}

/// Images per block: as many as [`BLOCK_BYTES`] say, spread evenly over the blocks.
fn block_steps(steps: usize, image_bytes: usize) -> usize {
    let most = (BLOCK_BYTES / image_bytes.max(1)).max(1);
    let blocks = steps.div_ceil(most).max(1);
    steps.div_ceil(blocks).max(1)
}

#[cfg(test)]
mod tests;
