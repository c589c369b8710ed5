//! Files that are there whole or not at all.

use std::fs::{self, File};
use std::io::Write;
use std::path::Path;

use crate::{Error, Result};

/// Writes `path` in one step: whoever reads it meets the old content or the new one, also after a crash of the machine
/// or on a full disk. What is written first lies beside it, under the same name with `.tmp`.
///
/// # Errors
/// [`Error::Io`]; the old content is kept.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut part = path.as_os_str().to_owned();
    part.push(".tmp");
    let part = Path::new(&part);
    File::create(part)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .map_err(Error::io("write", part))?;
    fs::rename(part, path).map_err(Error::io("rename to", path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_cannot_be_written_keeps_what_it_had() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("config.toml");
        write_whole(&path, b"old").unwrap();
        // As a full disk would: there is no place for the new content.
        fs::create_dir(dir.path().join("config.toml.tmp")).unwrap();
        let error = write_whole(&path, b"new").unwrap_err().to_string();
        assert!(error.contains("config.toml.tmp"), "{error}");
        assert_eq!(fs::read(&path).unwrap(), b"old");
        fs::remove_dir(dir.path().join("config.toml.tmp")).unwrap();
        write_whole(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(
            fs::read_dir(dir.path()).unwrap().count(),
            1,
            "nothing stays beside it"
        );
    }
}
