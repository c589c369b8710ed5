//! Wrong clocks: `libfaketime`, loaded into a process before its own libraries, shifts its wall clock.

use std::path::Path;

use anyhow::{Context, Result};

/// Where Debian and others put the library.
const LIBRARIES: [&str; 3] = [
    "/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1",
    "/usr/lib/aarch64-linux-gnu/faketime/libfaketimeMT.so.1",
    "/usr/lib/faketime/libfaketimeMT.so.1",
];

/// Path of the library.
pub(crate) fn library() -> Result<&'static str> {
    let library = LIBRARIES.into_iter().find(|path| Path::new(path).exists());
    library.context("libfaketime is not installed; install the package faketime")
}
