//! `metrics.jsonl`: one JSON object per line, appended to across restarts of a run.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde::ser::{SerializeMap, Serializer};

use crate::metrics::ResumePoint;
use crate::{Error, Result};

const FRAMES: &str = "frames";
const TIME: &str = "time";

/// Appends metric lines to one file.
#[derive(Debug)]
pub(crate) struct JsonlWriter {
    file: File,
    path: PathBuf,
}

/// One whole line.
#[derive(Debug, PartialEq, Deserialize)]
pub(crate) struct Line {
    pub(crate) frames: u64,
    pub(crate) time: f64,
    #[serde(flatten)]
    pub(crate) values: BTreeMap<String, Option<f64>>,
}

impl JsonlWriter {
    /// Opens `path` for appending, after [`clean_up`] has removed what a killed run left behind. Returns the
    /// lines beyond `resume` that stay.
    pub(crate) fn open(path: &Path, resume: &ResumePoint<'_>) -> Result<(Self, Vec<Line>)> {
        let later = clean_up(path, resume).map_err(Error::io("clean up", path))?;
        let file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(path)
            .map_err(Error::io("open", path))?;
        let writer = Self {
            file,
            path: path.to_owned(),
        };
        Ok((writer, later))
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

/// Removes every line that is not whole, and those that a run which goes back to `resume` writes again.
/// Returns the later lines that stay.
fn clean_up(path: &Path, resume: &ResumePoint<'_>) -> io::Result<Vec<Line>> {
    let source = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error),
    };
    let redone = |line: &Line| {
        let count = line.values.get(resume.counter).copied().flatten();
        count.is_some_and(|count| count > resume.count)
    };
    let mut stay = Vec::new();
    let mut kept_path = path.as_os_str().to_owned();
    kept_path.push(".tmp");
    let mut reader = BufReader::new(source);
    let mut kept = BufWriter::new(File::create(&kept_path)?);
    let (mut torn, mut removed) = (0_u64, 0_u64);
    let mut line = Vec::new();
    while reader.read_until(b'\n', &mut line)? > 0 {
        match serde_json::from_slice::<Line>(&line) {
            Ok(whole) if line.ends_with(b"\n") => {
                if redone(&whole) {
                    removed += 1;
                } else {
                    kept.write_all(&line)?;
                    if whole.frames > resume.frames {
                        stay.push(whole);
                    }
                }
            }
            _ => torn += 1,
        }
        line.clear();
    }
    if torn == 0 && removed == 0 {
        fs::remove_file(&kept_path)?;
        return Ok(stay);
    }
    kept.into_inner()
        .map_err(io::IntoInnerError::into_error)?
        .sync_all()?;
    fs::rename(&kept_path, path)?;
    tracing::info!(path = %path.display(), torn, removed, "metric lines removed on resume");
    Ok(stay)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    const BEGINNING: ResumePoint<'static> = ResumePoint {
        frames: 0,
        counter: "updates",
        count: 0.0,
    };

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
    fn resuming_removes_torn_lines_and_those_that_will_be_written_again() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("metrics.jsonl");
        let (mut writer, _) = JsonlWriter::open(&path, &BEGINNING).unwrap();
        for (frames, name, value) in [
            (10, "updates", 1.0),
            (20, "updates", 2.0),
            (30, "score", -7.0),
            (30, "updates", 3.0),
        ] {
            writer.line(frames, 0.5, &[(name, value)]).unwrap();
        }
        writer.file.write_all(b"{\"frames\":15,\"ti").unwrap();

        let resume = ResumePoint {
            frames: 20,
            counter: "updates",
            count: 2.0,
        };
        let (mut writer, later) = JsonlWriter::open(&path, &resume).unwrap();
        writer.line(31, 0.5, &[("updates", 3.0)]).unwrap();
        let frames: Vec<_> = lines(&path)
            .iter()
            .map(|line| line["frames"].clone())
            .collect();
        assert_eq!(
            frames,
            [json!(10), json!(20), json!(30), json!(31)],
            "the episode of 30 stays, nobody reports it again"
        );
        let score = Line {
            frames: 30,
            time: 0.5,
            values: [("score".to_owned(), Some(-7.0))].into(),
        };
        assert_eq!(later, [score]);
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
        let whole = "{\"frames\":1,\"time\":0.0}\n";
        fs::write(&path, format!("{whole}{{\"frames\":2,\"time\":0.0}}")).unwrap();
        JsonlWriter::open(&path, &BEGINNING).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), whole);
    }
}
