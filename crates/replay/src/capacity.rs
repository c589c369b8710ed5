//! How much a store keeps.

/// What is kept at most; beyond it the oldest episodes are evicted. The newest episode always stays.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Capacity {
    /// Steps.
    pub steps: u64,
    /// Bytes of records. Disk space is freed in whole segments, so that a folder holds up to one segment and one
    /// episode more.
    pub bytes: u64,
}

impl Capacity {
    /// Everything is kept.
    pub const UNLIMITED: Self = Self {
        steps: u64::MAX,
        bytes: u64::MAX,
    };

    /// So many steps, of any size.
    pub const fn steps(steps: u64) -> Self {
        Self {
            steps,
            ..Self::UNLIMITED
        }
    }

    pub(crate) fn is_exceeded(&self, steps: u64, bytes: u64) -> bool {
        steps > self.steps || bytes > self.bytes
    }
}
