//! Random damage.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Numbers that lengths and counts break on.
const EDGES: [u32; 6] = [0, 1, 0x7f, 0xff, 0x7fff_ffff, u32::MAX];

/// `input` after one to four strokes of damage.
pub(crate) fn damaged(input: &[u8], rng: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = input.to_vec();
    for _ in 0..rng.random_range(1..=4) {
        let at = rng.random_range(0..=bytes.len());
        match rng.random_range(0..6) {
            0 => bytes.truncate(at),
            1 if at < bytes.len() => bytes[at] ^= 1 << rng.random_range(0..8),
            2 if at < bytes.len() => bytes[at] = rng.random(),
            3 => {
                let edge = EDGES[rng.random_range(0..EDGES.len())].to_le_bytes();
                let end = bytes.len().min(at + edge.len());
                bytes.splice(at..end, edge);
            }
            4 => {
                let extra: [u8; 8] = rng.random();
                bytes.splice(at..at, extra);
            }
            _ => {
                // A part of itself, somewhere else.
                let end = bytes.len().min(at + rng.random_range(0..64));
                let part = bytes[at..end].to_vec();
                let to = rng.random_range(0..=bytes.len());
                bytes.splice(to..to, part);
            }
        }
    }
    bytes
}
