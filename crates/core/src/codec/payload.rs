//! Reading a payload: its sizes first, then the steps that are wanted.

use std::ops::Range;

use bytes::Buf;

use super::{DecodeError, HEADER_BYTES, MAX_DECODED_BYTES, block};

/// A payload whose sizes were found to fit each other; its images are not looked at.
#[derive(Debug, Clone, Copy)]
pub struct Payload<'a> {
    steps: usize,
    image_bytes: usize,
    action_dim: usize,
    block_steps: usize,
    actions: &'a [u8],
    rewards: &'a [u8],
    discounts: &'a [u8],
    flags: &'a [u8],
    table: &'a [u8],
    blocks: &'a [u8],
}

impl<'a> Payload<'a> {
    /// Reads the sizes of a payload. Takes no memory.
    ///
    /// # Errors
    /// [`DecodeError`] where they do not fit each other, or promise more than [`MAX_DECODED_BYTES`].
    pub fn parse(payload: &'a [u8]) -> Result<Self, DecodeError> {
        let need = |need: usize| match payload.len() {
            have if have < need => Err(DecodeError::Truncated { have, need }),
            _ => Ok(()),
        };
        need(HEADER_BYTES)?;
        let mut header = payload;
        let [steps, image_bytes, action_dim, block_steps] =
            std::array::from_fn(|_| header.get_u32_le() as usize);
        let total = steps as u128 * (image_bytes as u128 + 4 * action_dim as u128 + 9);
        if total > MAX_DECODED_BYTES as u128 {
            return Err(DecodeError::TooLarge {
                bytes: u64::try_from(total).unwrap_or(u64::MAX),
            });
        }
        if block_steps == 0 {
            return Err(DecodeError::EmptyBlocks);
        }
        let sizes = [
            4 * steps * action_dim,
            4 * steps,
            4 * steps,
            steps,
            4 * steps.div_ceil(block_steps),
        ];
        need(HEADER_BYTES + sizes.iter().sum::<usize>())?;
        let mut rest = &payload[HEADER_BYTES..];
        let [actions, rewards, discounts, flags, table] = sizes.map(|bytes| {
            let (column, behind) = rest.split_at(bytes);
            rest = behind;
            column
        });
        let parsed = Self {
            steps,
            image_bytes,
            action_dim,
            block_steps,
            actions,
            rewards,
            discounts,
            flags,
            table,
            blocks: rest,
        };
        let stored: usize = parsed.entries().map(block::stored_bytes).sum();
        need(payload.len() - rest.len() + stored)?;
        match rest.len() - stored {
            0 => Ok(parsed),
            bytes => Err(DecodeError::Surplus { bytes }),
        }
    }

    /// Steps held.
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Bytes of one image.
    pub fn image_bytes(&self) -> usize {
        self.image_bytes
    }

    /// Action dimensions.
    pub fn action_dim(&self) -> usize {
        self.action_dim
    }

    /// [`crate::Steps::flags`].
    pub fn flags(&self) -> &'a [u8] {
        self.flags
    }

    fn entries(&self) -> impl Iterator<Item = u32> + use<'a> {
        self.table
            .chunks_exact(4)
            .map(|mut entry| entry.get_u32_le())
    }
}

/// Memory for decoded steps, for example a part of a batch.
#[derive(Debug)]
pub struct Rows<'a> {
    /// `[steps, H, W, C]` bytes.
    pub images: &'a mut [u8],
    /// `[steps, action_dim]`.
    pub actions: &'a mut [f32],
    /// `[steps]`.
    pub rewards: &'a mut [f32],
    /// `[steps]`.
    pub discounts: &'a mut [f32],
}

impl<'a> Rows<'a> {
    /// The first `steps` of these rows, and the others.
    ///
    /// # Panics
    /// If there are fewer: a defect of the caller.
    pub fn split_at(self, steps: usize) -> (Self, Self) {
        let held = self.rewards.len().max(1);
        let (image_bytes, action_dim) = (self.images.len() / held, self.actions.len() / held);
        let (images, other_images) = self.images.split_at_mut(steps * image_bytes);
        let (actions, other_actions) = self.actions.split_at_mut(steps * action_dim);
        let (rewards, other_rewards) = self.rewards.split_at_mut(steps);
        let (discounts, other_discounts) = self.discounts.split_at_mut(steps);
        let first = Self {
            images,
            actions,
            rewards,
            discounts,
        };
        let others = Self {
            images: other_images,
            actions: other_actions,
            rewards: other_rewards,
            discounts: other_discounts,
        };
        (first, others)
    }
}

/// Decodes parts of payloads. Keeps the memory that blocks need of which only a part is wanted.
#[derive(Debug, Default)]
pub struct Decoder {
    pub(super) block: Vec<u8>,
}

impl Decoder {
    /// Decodes the steps `range` of `payload` into `rows`, and no block that holds none of them.
    ///
    /// # Errors
    /// [`DecodeError`] where a block is damaged or the payload does not hold the range; `rows` then holds anything.
    ///
    /// # Panics
    /// If `rows` has other sizes than the range of this payload: a defect of the caller.
    pub fn decode_into(
        &mut self,
        payload: &Payload<'_>,
        range: Range<usize>,
        rows: Rows<'_>,
    ) -> Result<(), DecodeError> {
        if range.end > payload.steps {
            return Err(DecodeError::OutOfRange {
                end: range.end,
                steps: payload.steps,
            });
        }
        let (bytes, dim) = (payload.image_bytes, payload.action_dim);
        assert_eq!(rows.images.len(), range.len() * bytes, "images");
        copy_floats(payload.actions, scaled(&range, dim), rows.actions);
        copy_floats(payload.rewards, range.clone(), rows.rewards);
        copy_floats(payload.discounts, range.clone(), rows.discounts);
        let mut images = rows.images;
        let mut stored = payload.blocks;
        for (index, entry) in payload.entries().enumerate() {
            let packed;
            (packed, stored) = stored.split_at(block::stored_bytes(entry));
            let first = index * payload.block_steps;
            let held = first..payload.steps.min(first + payload.block_steps);
            let wanted = range.start.max(held.start)..range.end.min(held.end);
            if wanted.is_empty() {
                continue;
            }
            let (out, behind) = images.split_at_mut(wanted.len() * bytes);
            images = behind;
            let damaged = |reason| DecodeError::Images {
                block: index,
                reason,
            };
            if wanted == held {
                block::unpack(entry, packed, out).map_err(damaged)?;
                continue;
            }
            self.block.resize(held.len() * bytes, 0);
            block::unpack(entry, packed, &mut self.block).map_err(damaged)?;
            let skipped = (wanted.start - held.start) * bytes;
            out.copy_from_slice(&self.block[skipped..skipped + out.len()]);
        }
        Ok(())
    }
}

fn scaled(range: &Range<usize>, by: usize) -> Range<usize> {
    range.start * by..range.end * by
}

fn copy_floats(stored: &[u8], range: Range<usize>, out: &mut [f32]) {
    let stored = stored[scaled(&range, 4)].chunks_exact(4);
    assert_eq!(stored.len(), out.len(), "columns");
    for (value, mut bytes) in out.iter_mut().zip(stored) {
        *value = bytes.get_f32_le();
    }
}
