//! What must be there before anything is fetched, each with its cure.

use std::env;
use std::path::Path;
use std::process::Command;

use anyhow::{Result, bail};

use crate::stage::answers;

/// The wheels and what is unpacked from them need about 1 GB, a build of the workspace the rest.
const MIN_FREE_KIB: u64 = 3 << 20;

/// The C++ compiler that the `tch` build will look for.
pub(super) fn compiler() -> Result<()> {
    let from_environment = env::var("CXX").ok();
    let candidates: Vec<&str> = match &from_environment {
        Some(name) => vec![name.split_whitespace().next().unwrap_or_default()],
        None => vec!["c++", "g++", "clang++"],
    };
    if candidates
        .iter()
        .any(|name| answers(Command::new(name).arg("--version")))
    {
        return Ok(());
    }
    bail!(
        "no C++ compiler ({}): install g++ (Debian, Ubuntu: apt-get install g++; Fedora: dnf install gcc-c++; \
         macOS: xcode-select --install), or point CXX at one",
        candidates.join(", ")
    )
}

/// Python and pip, which fetch and unpack `what`; `otherwise` says how to do without.
pub(super) fn python(what: &str, otherwise: &str) -> Result<()> {
    if !answers(Command::new("python3").arg("--version")) {
        bail!(
            "python3 is missing, it fetches {what}: install it (Debian, Ubuntu: apt-get install python3 \
             python3-pip), {otherwise}"
        );
    }
    if !answers(Command::new("python3").args(["-m", "pip", "--version"])) {
        bail!(
            "pip is missing, it fetches {what}: install it (Debian, Ubuntu: apt-get install python3-pip; \
             elsewhere: python3 -m ensurepip), {otherwise}"
        );
    }
    Ok(())
}

/// Room for the wheels and what is unpacked from them.
pub(super) fn disk(folder: &Path) -> Result<()> {
    // Where df answers nothing we understand, running out of space will say it later.
    if let Some(free_kib) = free_kib(folder)
        && free_kib < MIN_FREE_KIB
    {
        bail!(
            "only {} MB are free in {}: libtorch and a build need {} MB, make room or move the repository",
            free_kib >> 10,
            folder.display(),
            MIN_FREE_KIB >> 10
        );
    }
    Ok(())
}

fn free_kib(folder: &Path) -> Option<u64> {
    let output = Command::new("df").arg("-Pk").arg(folder).output().ok()?;
    parse_df(&String::from_utf8(output.stdout).ok()?)
}

/// The fourth column of the second line, as POSIX has it.
fn parse_df(text: &str) -> Option<u64> {
    text.lines().nth(1)?.split_whitespace().nth(3)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn df_is_understood() {
        let text =
            "Filesystem 1024-blocks Used Available Capacity Mounted on\n/dev/vda 263 14 78 16% /\n";
        assert_eq!(parse_df(text), Some(78));
        assert_eq!(parse_df("df: no such thing\n"), None);
        assert!(free_kib(Path::new("/")).is_some());
    }
}
