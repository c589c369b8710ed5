//! One of a kind per run directory, and an epoch for each start of a learner.

use std::fs::{File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, bail};

/// Makes the run directory this learner's alone for as long as the returned file is open: two of them would
/// overwrite each other's checkpoints and metrics. With it comes the learner's epoch, greater than at any earlier
/// start in this run directory.
pub(crate) fn lock_for_learner(run_dir: &Path) -> anyhow::Result<(File, u64)> {
    let mut file = lock(run_dir, "learner")?;
    let epoch = next_epoch(&mut file)
        .with_context(|| format!("cannot write the learner's lock in {}", run_dir.display()))?;
    Ok((file, epoch))
}

/// Makes the run directory, where there is none, and lets no other process take the part of `who` in it for as long as
/// the returned file is open.
///
/// # Errors
/// Where somebody has it, or the folder cannot be written.
pub fn lock(run_dir: &Path, who: &str) -> anyhow::Result<File> {
    let path = run_dir.join(format!(".{who}.lock"));
    std::fs::create_dir_all(run_dir)
        .with_context(|| format!("cannot create {}", run_dir.display()))?;
    let file = File::options()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .open(&path)
        .with_context(|| format!("cannot create {}", path.display()))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => bail!(
            "{} is in use by another {who}; stop it or choose another --run-dir",
            run_dir.display()
        ),
        Err(TryLockError::Error(error)) => {
            Err(error).with_context(|| format!("cannot lock {}", path.display()))
        }
    }
}

/// The epoch of this start, which takes the place of the one before in `file`: milliseconds since 1970, or more where
/// the clock was set back or is another machine's.
fn next_epoch(file: &mut File) -> std::io::Result<u64> {
    let mut text = String::new();
    file.read_to_string(&mut text)?;
    let before = text.trim().parse().unwrap_or(0_u64);
    let now = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_millis() as u64);
    let epoch = now.max(before + 1);
    file.rewind()?;
    file.set_len(0)?;
    writeln!(file, "{epoch}")?;
    file.sync_data()?;
    Ok(epoch)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_grows_at_every_start_whatever_the_clock_says() {
        let mut file = tempfile::tempfile().unwrap();
        let first = next_epoch(&mut file).unwrap();
        assert!(first > 1_700_000_000_000, "milliseconds of today");
        // As if the last start had been on a machine whose clock is a year ahead.
        let ahead = first + 31_536_000_000;
        file.set_len(0).unwrap();
        file.rewind().unwrap();
        writeln!(file, "{ahead}").unwrap();
        for start in 1..=2 {
            file.rewind().unwrap();
            assert_eq!(next_epoch(&mut file).unwrap(), ahead + start);
        }
    }
}
