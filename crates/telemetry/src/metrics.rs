//! Metrics of a run, in the two forms people read: JSON lines and TensorBoard.

use std::fs;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use crate::jsonl::{JsonlWriter, check_name};
use crate::{Error, EventWriter, Gif, Result, Rgb};

/// The point a run goes back to when it resumes; all of it is 0 where nothing was kept.
#[derive(Debug, Clone, Copy)]
pub struct ResumePoint<'a> {
    /// Environment frames at that point.
    pub frames: u64,
    /// The metric that counts what is done again, for example `train/updates`.
    pub counter: &'a str,
    /// Its value at that point.
    pub count: f64,
}

/// Writes `metrics.jsonl` and a TensorBoard event file into one folder. The x axis of everything is
/// environment frames, action repeat counted.
#[derive(Debug)]
pub struct MetricsWriter {
    jsonl: JsonlWriter,
    events: EventWriter,
}

impl MetricsWriter {
    /// Opens the metrics in `dir`, which is made if needed. Where a run was here before, its lines are
    /// appended to; a line torn by a crash is removed.
    ///
    /// Lines in which the counter of `resume` is beyond that point are removed, because the run will write
    /// them a second time. All others stay, those of later frames too: an episode is reported once.
    /// TensorBoard gets a new event file that says the same.
    ///
    /// # Errors
    /// [`Error::Io`] if the folder or its files cannot be read and written.
    pub fn open(dir: &Path, resume: &ResumePoint<'_>) -> Result<Self> {
        fs::create_dir_all(dir).map_err(Error::io("create", dir))?;
        let (jsonl, later) = JsonlWriter::open(&dir.join("metrics.jsonl"), resume)?;
        let mut events = EventWriter::create(dir, resume.frames)?;
        for line in later {
            let values: Vec<(String, f64)> = line
                .values
                .into_iter()
                .map(|(name, value)| (name, value.unwrap_or(f64::NAN)))
                .collect();
            events.scalars(line.frames, line.time, &values)?;
        }
        Ok(Self { jsonl, events })
    }

    /// Writes `values` as one JSON line and one TensorBoard event. A value that is not finite becomes
    /// `null` in JSON.
    ///
    /// # Errors
    /// [`Error::ReservedName`] if a metric is called `frames` or `time`; [`Error::Io`].
    pub fn scalars<N: AsRef<str>>(&mut self, frames: u64, values: &[(N, f64)]) -> Result<()> {
        for (name, _) in values {
            check_name(name.as_ref())?;
        }
        let time_secs = unix_time_secs();
        self.jsonl.line(frames, time_secs, values)?;
        self.events.scalars(frames, time_secs, values)
    }

    /// Writes a picture to TensorBoard.
    ///
    /// # Errors
    /// [`Error::Png`], [`Error::Io`].
    pub fn image(&mut self, frames: u64, name: &str, image: &Rgb) -> Result<()> {
        self.events.image(frames, unix_time_secs(), name, image)
    }

    /// Writes an animation to TensorBoard.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn animation(&mut self, frames: u64, name: &str, gif: &Gif) -> Result<()> {
        self.events.animation(frames, unix_time_secs(), name, gif)
    }

    /// Waits until everything written so far would survive a crash of the machine. Readers see it
    /// without that.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn flush(&mut self) -> Result<()> {
        self.jsonl.sync()?;
        self.events.sync()
    }
}

/// Seconds since 1970; 0 on a machine whose clock stands before it.
pub(crate) fn unix_time_secs() -> f64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0.0, |elapsed| elapsed.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resume(frames: u64, count: f64) -> ResumePoint<'static> {
        ResumePoint {
            frames,
            counter: "train/updates",
            count,
        }
    }

    fn event_files(dir: &Path) -> usize {
        let name = |entry: std::io::Result<fs::DirEntry>| {
            entry.unwrap().file_name().into_string().unwrap()
        };
        fs::read_dir(dir)
            .unwrap()
            .map(name)
            .filter(|name| name.starts_with("events.out.tfevents."))
            .count()
    }

    #[test]
    fn a_resumed_run_appends_lines_and_starts_a_new_event_file() {
        let dir = tempfile::tempdir().unwrap();
        let run = dir.path().join("run");
        for (frames, count) in [(0, 0.0), (0, 0.0), (100, 1.0)] {
            let resume = resume(frames, count);
            let mut metrics = MetricsWriter::open(&run, &resume).unwrap();
            for (frames, updates) in [(50, 1.0), (150, 2.0)] {
                metrics
                    .scalars(frames, &[("train/updates", updates)])
                    .unwrap();
            }
            metrics
                .image(50, "open_loop", &Rgb::filled(4, 4, [9, 8, 7]))
                .unwrap();
            metrics.flush().unwrap();
        }
        let lines = fs::read_to_string(run.join("metrics.jsonl")).unwrap();
        assert_eq!(
            lines.lines().count(),
            3,
            "50 of the second life, which began anew, 50 and 150 of the third:\n{lines}"
        );
        assert_eq!(event_files(&run), 3);
    }

    #[test]
    fn a_reserved_name_is_refused_before_anything_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let mut metrics = MetricsWriter::open(dir.path(), &resume(0, 0.0)).unwrap();
        let error = metrics
            .scalars(1, &[("a", 1.0), ("time", 2.0)])
            .unwrap_err();
        assert!(error.to_string().contains("`time`"), "{error}");
        assert_eq!(fs::read(dir.path().join("metrics.jsonl")).unwrap(), b"");
    }
}
