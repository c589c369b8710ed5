//! The encoding of a chunk's payload: small columns as they are, images compressed with LZ4.
//!
//! Layout, little-endian: `steps u32 | image_bytes u32 | action_dim u32 | actions | rewards | discounts |
//! flags | lz4 block of the images`. The size of the images follows from the header and is capped before
//! memory is taken, so a forged payload cannot ask for more than [`MAX_DECODED_BYTES`].

use bytes::{Buf, BufMut, Bytes, BytesMut};

use crate::Steps;

/// The most bytes of images one payload may decode to.
pub const MAX_DECODED_BYTES: usize = 64 << 20;

const HEADER_BYTES: usize = 12;

/// A payload that is not what [`encode`] makes.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum DecodeError {
    /// Fewer bytes than the header promises.
    #[error("payload is truncated: {have} bytes where {need} are needed")]
    Truncated {
        /// Bytes that are there.
        have: usize,
        /// Bytes the header promises.
        need: usize,
    },
    /// The header asks for more memory than a chunk may need.
    #[error("payload would decode to {bytes} bytes, more than the cap of {MAX_DECODED_BYTES}")]
    TooLarge {
        /// Bytes the header promises.
        bytes: u64,
    },
    /// The image block is damaged.
    #[error("image block is damaged: {0}")]
    Images(String),
}

/// Encodes `steps`.
pub fn encode(steps: &Steps) -> Bytes {
    let images = lz4_flex::block::compress(&steps.images);
    let small = steps.len * (4 * steps.action_dim + 9);
    let mut out = BytesMut::with_capacity(HEADER_BYTES + small + images.len());
    out.put_u32_le(steps.len as u32);
    out.put_u32_le(steps.image_bytes as u32);
    out.put_u32_le(steps.action_dim as u32);
    for value in steps
        .actions
        .iter()
        .chain(&steps.rewards)
        .chain(&steps.discounts)
    {
        out.put_f32_le(*value);
    }
    out.put_slice(&steps.flags);
    out.put_slice(&images);
    out.freeze()
}

/// Decodes what [`encode`] made.
///
/// # Errors
/// [`DecodeError`] on any payload that `encode` cannot have made; never panics, never takes more memory
/// than the cap.
pub fn decode(payload: &[u8]) -> Result<Steps, DecodeError> {
    let mut rest = payload;
    need(rest.len(), HEADER_BYTES)?;
    let len = rest.get_u32_le() as usize;
    let image_bytes = rest.get_u32_le() as usize;
    let action_dim = rest.get_u32_le() as usize;
    let per_step = image_bytes as u128 + 4 * action_dim as u128 + 9;
    let total = len as u128 * per_step;
    if total > MAX_DECODED_BYTES as u128 {
        return Err(DecodeError::TooLarge {
            bytes: u64::try_from(total).unwrap_or(u64::MAX),
        });
    }
    need(rest.len(), len * (4 * action_dim + 9))?;
    let mut floats = |count: usize| -> Vec<f32> { (0..count).map(|_| rest.get_f32_le()).collect() };
    let actions = floats(len * action_dim);
    let rewards = floats(len);
    let discounts = floats(len);
    let flags = rest[..len].to_vec();
    rest = &rest[len..];
    let mut images = vec![0; len * image_bytes];
    let written = lz4_flex::block::decompress_into(rest, &mut images)
        .map_err(|error| DecodeError::Images(error.to_string()))?;
    if written != images.len() {
        return Err(DecodeError::Images(format!(
            "{written} bytes where {} belong",
            images.len()
        )));
    }
    Ok(Steps {
        len,
        image_bytes,
        action_dim,
        images,
        actions,
        rewards,
        discounts,
        flags,
    })
}

fn need(have: usize, need: usize) -> Result<(), DecodeError> {
    if have < need {
        return Err(DecodeError::Truncated { have, need });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::Step;

    fn steps() -> impl Strategy<Value = Steps> {
        let step = (
            prop::collection::vec(any::<u8>(), 27),
            prop::collection::vec(-1.0_f32..1.0, 2),
            -10.0_f32..10.0,
            any::<(bool, bool, bool)>(),
        )
            .prop_map(
                |(image, action, reward, (is_first, is_last, is_terminal))| Step {
                    image,
                    action,
                    reward,
                    discount: f32::from(u8::from(!is_terminal)),
                    is_first,
                    is_last,
                    is_terminal,
                },
            );
        prop::collection::vec(step, 0..20).prop_map(|rows| {
            let mut steps = Steps::new(27, 2);
            for row in &rows {
                steps.push(row);
            }
            steps
        })
    }

    proptest! {
        #[test]
        fn decoding_returns_what_was_encoded(steps in steps()) {
            prop_assert_eq!(decode(&encode(&steps)), Ok(steps));
        }

        #[test]
        fn every_truncation_is_an_error(steps in steps(), cut in 0.0_f64..1.0) {
            let payload = encode(&steps);
            let kept = (payload.len() as f64 * cut) as usize;
            prop_assume!(steps.len > 0 && kept < payload.len());
            prop_assert!(decode(&payload[..kept]).is_err());
        }

        #[test]
        fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = decode(&bytes);
        }
    }

    #[test]
    fn a_bomb_is_refused_before_memory_is_taken() {
        let mut payload = Vec::new();
        payload.extend_from_slice(&u32::MAX.to_le_bytes());
        payload.extend_from_slice(&u32::MAX.to_le_bytes());
        payload.extend_from_slice(&2_u32.to_le_bytes());
        assert!(matches!(
            decode(&payload),
            Err(DecodeError::TooLarge { .. })
        ));
    }
}
