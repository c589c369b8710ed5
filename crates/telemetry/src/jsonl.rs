//! `metrics.jsonl`: one JSON object per line, appended to across restarts of a run.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde::ser::{SerializeMap, Serializer};

use crate::{Error, Result};

const FRAMES: &str = "frames";
const TIME: &str = "time";

/// Appends metric lines to one file.
#[derive(Debug)]
pub(crate) struct JsonlWriter {
    file: File,
    path: PathBuf,
}

/// The one field of a line that resuming needs.
#[derive(Deserialize)]
struct Position {
    frames: u64,
}

impl JsonlWriter {
    /// Opens `path` for appending, after [`keep_until`] has removed what a killed run left behind.
    pub(crate) fn open(path: &Path, resume_frames: Option<u64>) -> Result<Self> {
        keep_until(path, resume_frames).map_err(Error::io("clean up", path))?;
        let file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(path)
            .map_err(Error::io("open", path))?;
        Ok(Self {
            file,
            path: path.to_owned(),
        })
    }

    /// Appends one line in one write, so that readers never wait for a buffer.
    pub(crate) fn line<N: AsRef<str>>(
        &mut self,
        frames: u64,
        time_secs: f64,
        values: &[(N, f64)],
    ) -> Result<()> {
        let mut line = Vec::with_capacity(64 + 32 * values.len());
        write_line(&mut line, frames, time_secs, values).map_err(|error| Error::Io {
            action: "encode a line of",
            path: self.path.clone(),
            source: error.into(),
        })?;
        self.file
            .write_all(&line)
            .map_err(Error::io("append to", &self.path))
    }

    /// Waits until every line is on disk.
    pub(crate) fn sync(&self) -> Result<()> {
        self.file.sync_data().map_err(Error::io("sync", &self.path))
    }
}

/// Refuses the names that every line uses itself.
pub(crate) fn check_name(name: &str) -> Result<()> {
    if name == FRAMES || name == TIME {
        return Err(Error::ReservedName {
            name: name.to_owned(),
        });
    }
    Ok(())
}

fn write_line<N: AsRef<str>>(
    out: &mut Vec<u8>,
    frames: u64,
    time_secs: f64,
    values: &[(N, f64)],
) -> serde_json::Result<()> {
    let mut serializer = serde_json::Serializer::new(&mut *out);
    let mut map = serializer.serialize_map(Some(values.len() + 2))?;
    map.serialize_entry(FRAMES, &frames)?;
    map.serialize_entry(TIME, &time_secs)?;
    for (name, value) in values {
        map.serialize_entry(name.as_ref(), value)?;
    }
    map.end()?;
    out.push(b'\n');
    Ok(())
}

/// Removes every line that is not whole, and with `last_frames` those of later frames as well: the run
/// goes back to that point and writes them again.
fn keep_until(path: &Path, last_frames: Option<u64>) -> io::Result<()> {
    let source = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error),
    };
    let mut kept_path = path.as_os_str().to_owned();
    kept_path.push(".tmp");
    let mut reader = BufReader::new(source);
    let mut kept = BufWriter::new(File::create(&kept_path)?);
    let (mut torn, mut later) = (0_u64, 0_u64);
    let mut line = Vec::new();
    while reader.read_until(b'\n', &mut line)? > 0 {
        match serde_json::from_slice::<Position>(&line) {
            Ok(position) if line.ends_with(b"\n") => {
                if last_frames.is_some_and(|last| position.frames > last) {
                    later += 1;
                } else {
                    kept.write_all(&line)?;
                }
            }
            _ => torn += 1,
        }
        line.clear();
    }
    if torn == 0 && later == 0 {
        return fs::remove_file(&kept_path);
    }
    kept.into_inner()
        .map_err(io::IntoInnerError::into_error)?
        .sync_all()?;
    fs::rename(&kept_path, path)?;
    tracing::info!(path = %path.display(), torn, later, "metric lines removed on resume");
    Ok(())
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn lines(path: &Path) -> Vec<Value> {
        let text = fs::read_to_string(path).unwrap();
        text.lines()
            .map(|line| serde_json::from_str(line).unwrap())
            .collect()
    }

    #[test]
    fn lines_start_with_frames_and_time() {
        let mut out = Vec::new();
        write_line(&mut out, 7, 1.5, &[("b", 2.0), ("a", f64::NAN)]).unwrap();
        assert_eq!(
            String::from_utf8(out).unwrap(),
            "{\"frames\":7,\"time\":1.5,\"b\":2.0,\"a\":null}\n"
        );
    }

    #[test]
    fn resuming_removes_torn_and_later_lines_and_appends() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("metrics.jsonl");
        let mut writer = JsonlWriter::open(&path, None).unwrap();
        for frames in [10, 30, 20] {
            writer.line(frames, 0.0, &[("x", frames as f64)]).unwrap();
        }
        writer.file.write_all(b"{\"frames\":15,\"ti").unwrap();

        let mut writer = JsonlWriter::open(&path, Some(20)).unwrap();
        writer.line(21, 0.0, &[("x", 21.0)]).unwrap();
        let frames: Vec<_> = lines(&path)
            .iter()
            .map(|line| line["frames"].clone())
            .collect();
        assert_eq!(frames, [json!(10), json!(20), json!(21)]);
        assert_eq!(
            fs::read_dir(dir.path()).unwrap().count(),
            1,
            "temporary files are left"
        );
    }

    #[test]
    fn a_whole_line_without_its_newline_is_torn() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("metrics.jsonl");
        fs::write(&path, "{\"frames\":1}\n{\"frames\":2}").unwrap();
        JsonlWriter::open(&path, None).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "{\"frames\":1}\n");
    }
}
