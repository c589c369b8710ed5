//! What commands print.

use std::io::{ErrorKind, Write as _};

use anyhow::Context as _;
use serde::Serialize;

/// The one place where results go to standard output; logs and progress go to standard error. A reader that has read
/// enough, such as `head`, may have closed it.
///
/// # Errors
/// Where standard output is a file that takes no more.
pub(crate) fn print(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(error).context("cannot write the result to standard output")
        }
        _ => Ok(()),
    }
}

/// Prints a result for scripts or for people.
///
/// # Errors
/// Where the result has no JSON form, or cannot be written.
pub(crate) fn print_result<T: Serialize>(
    result: &T,
    json: bool,
    table: impl FnOnce(&T) -> String,
) -> anyhow::Result<()> {
    if json {
        print_json(result)
    } else {
        print(&table(result))
    }
}

/// Prints a result for scripts.
///
/// # Errors
/// As [`print_result`].
pub(crate) fn print_json<T: Serialize>(result: &T) -> anyhow::Result<()> {
    print(&serde_json::to_string_pretty(result)?)
}
