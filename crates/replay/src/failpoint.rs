//! Faults on demand, where the feature `failpoints` is on; else nothing.
//!
//! Points: `append-before-write`, `append-before-sync`, `append-sync`, `roll-created`, `roll-before-folder-sync`,
//! `evict-before-delete`, `evict-after-delete`, `open-segment`. What happens is said by the environment variable
//! `FAILPOINTS` or by the `fail` crate's functions: `return(abort)` ends the process as a crash would,
//! `return(full)` is a full disk, a bare `return` an input/output error.

use std::io;

/// An error, a crash or nothing, as is said of `point`.
#[cfg(feature = "failpoints")]
pub(crate) fn reach(point: &str) -> io::Result<()> {
    /// EIO.
    const INPUT_OUTPUT_ERROR: i32 = 5;
    fail::fail_point!(point, |action| Err(match action.as_deref() {
        Some("abort") => std::process::abort(),
        Some("full") => io::ErrorKind::StorageFull.into(),
        _ => io::Error::from_raw_os_error(INPUT_OUTPUT_ERROR),
    }));
    Ok(())
}

/// Nothing happens.
#[cfg(not(feature = "failpoints"))]
#[inline(always)]
#[allow(clippy::unnecessary_wraps)]
pub(crate) fn reach(_point: &str) -> io::Result<()> {
    Ok(())
}
