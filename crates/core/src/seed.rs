//! One seed tree: every random stream of a run is derived from `config.seed` and the names on its path.

use sha2::{Digest, Sha256};

/// The seed of the stream that `path` names under `root`: equal inputs give equal seeds, and streams
/// with different paths are independent.
///
/// ```
/// use isodream_core::derive_seed;
/// assert_eq!(derive_seed(1, &["actor", "0"]), derive_seed(1, &["actor", "0"]));
/// assert_ne!(derive_seed(1, &["actor", "0"]), derive_seed(1, &["actor", "1"]));
/// assert_ne!(derive_seed(1, &["ab", "c"]), derive_seed(1, &["a", "bc"]));
/// ```
pub fn derive_seed(root: u64, path: &[&str]) -> u64 {
    let mut hash = Sha256::new();
    hash.update(root.to_le_bytes());
    for name in path {
        hash.update((name.len() as u64).to_le_bytes());
        hash.update(name.as_bytes());
    }
    let digest = hash.finalize();
    let mut first = [0_u8; 8];
    first.copy_from_slice(&digest[..8]);
    u64::from_le_bytes(first)
}
