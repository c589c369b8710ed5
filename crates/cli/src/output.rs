//! What commands print.

use std::io::Write as _;

use serde::Serialize;

/// The one place where results go to standard output; logs and progress go to standard error. A reader that has read
/// enough, such as `head`, may have closed it.
pub(crate) fn print(text: &str) {
    let _ = writeln!(std::io::stdout(), "{text}");
}

/// Prints a result for scripts or for people.
///
/// # Errors
/// Where the result has no JSON form.
pub(crate) fn print_result<T: Serialize>(
    result: &T,
    json: bool,
    table: impl FnOnce(&T) -> String,
) -> anyhow::Result<()> {
    let text = if json {
        serde_json::to_string_pretty(result)?
    } else {
        table(result)
    };
    print(&text);
    Ok(())
}
