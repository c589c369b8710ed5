//! Tables that grow row by row, for spreadsheets and data frames.

use std::fs::{self, File, OpenOptions};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use csv::{Reader, Writer};

use crate::{Error, Result};

/// A CSV file with a header, appended to across restarts of a run.
#[derive(Debug)]
pub struct CsvLog {
    path: PathBuf,
    columns: Vec<String>,
    writer: Writer<File>,
}

impl CsvLog {
    /// Opens the table at `path`, or begins it with `columns`. A table that is there keeps its columns; a row torn by a
    /// crash is removed.
    ///
    /// # Errors
    /// [`Error::Io`] where the file cannot be read and written, or is no such table.
    pub fn open(path: &Path, columns: &[&str]) -> Result<Self> {
        let whole = remove_torn_row(path).map_err(Error::io("read", path))?;
        let file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(path)
            .map_err(Error::io("open", path))?;
        let mut log = Self {
            path: path.to_owned(),
            columns: columns.iter().map(|&name| name.to_owned()).collect(),
            writer: Writer::from_writer(file),
        };
        if whole == 0 {
            log.write(&log.columns.clone())?;
            return Ok(log);
        }
        let mut reader = Reader::from_path(path).map_err(|error| log.failed("read", error))?;
        let header = reader
            .headers()
            .map_err(|error| log.failed("read", error))?;
        log.columns = header.iter().map(str::to_owned).collect();
        Ok(log)
    }

    /// Appends a row. Fields of other names than the table's columns are left out, columns without a field stay empty.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn row(&mut self, fields: &[(&str, String)]) -> Result<()> {
        let field = |column: &String| {
            let found = fields.iter().find(|(name, _)| name == column);
            found.map_or_else(String::new, |(_, value)| value.clone())
        };
        let row: Vec<String> = self.columns.iter().map(field).collect();
        self.write(&row)
    }

    fn write(&mut self, row: &[String]) -> Result<()> {
        let written = self.writer.write_record(row);
        written.map_err(|error| self.failed("append to", error))?;
        self.writer
            .flush()
            .map_err(Error::io("append to", &self.path))
    }

    fn failed(&self, action: &'static str, error: csv::Error) -> Error {
        Error::io(action, &self.path)(error.into())
    }
}

/// Cuts off what follows the last line end, and returns how many bytes are left.
fn remove_torn_row(path: &Path) -> std::io::Result<u64> {
    let bytes = match fs::read(path) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(0),
        Err(error) => return Err(error),
    };
    let whole = bytes.iter().rposition(|&byte| byte == b'\n');
    let length = whole.map_or(0, |at| at as u64 + 1);
    if length < bytes.len() as u64 {
        OpenOptions::new().write(true).open(path)?.set_len(length)?;
    }
    Ok(length)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn rows_survive_restarts_and_a_torn_one_goes() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.csv");
        let mut log = CsvLog::open(&path, &["score", "why"]).unwrap();
        log.row(&[("why", "crash, at once".into()), ("score", "1.5".into())])
            .unwrap();
        drop(log);
        OpenOptions::new()
            .append(true)
            .open(&path)
            .unwrap()
            .write_all(b"2.5,ti")
            .unwrap();
        let mut log = CsvLog::open(&path, &["other"]).unwrap();
        log.row(&[("score", "3".into()), ("other", "x".into())])
            .unwrap();
        let text = fs::read_to_string(&path).unwrap();
        assert_eq!(text, "score,why\n1.5,\"crash, at once\"\n3,\n");
    }
}
