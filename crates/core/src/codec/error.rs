//! What can be wrong with a payload.

use super::MAX_DECODED_BYTES;

/// A payload that is not what [`encode`](super::encode) makes, or does not hold what is wanted of it.
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
    /// More bytes than the header promises.
    #[error("payload has {bytes} bytes behind its end")]
    Surplus {
        /// Bytes too many.
        bytes: usize,
    },
    /// The header asks for more memory than a chunk may need.
    #[error("payload would decode to {bytes} bytes, more than the cap of {MAX_DECODED_BYTES}")]
    TooLarge {
        /// Bytes the header promises.
        bytes: u64,
    },
    /// The header asks for images in blocks of none.
    #[error("payload has blocks of no steps")]
    EmptyBlocks,
    /// A block of images is damaged.
    #[error("image block {block} is damaged: {reason}")]
    Images {
        /// Index of the block.
        block: usize,
        /// What the decompressor says.
        reason: String,
    },
    /// Steps are wanted that the payload does not hold.
    #[error("steps up to {end} are wanted of a payload that holds {steps}")]
    OutOfRange {
        /// End of the wanted range.
        end: usize,
        /// Steps that are there.
        steps: usize,
    },
}
