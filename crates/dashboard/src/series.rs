//! Metrics over environment frames, read from a file that grows.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use serde::Serialize;

/// Points of an answer at most.
const POINTS: usize = 1_000;

/// One metric of one run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Series {
    /// `[frames, value]`, in the order in which they were written; where there are more than 1,000, means of as many
    /// neighbours as it takes.
    pub points: Vec<[f64; 2]>,
}

/// The metrics of a run as far as they were read.
#[derive(Debug, Default)]
pub(crate) struct Metrics {
    path: PathBuf,
    /// The file that was read, whatever its name: a run that goes back to a checkpoint puts another one in its place.
    inode: u64,
    /// Where reading goes on: after the last whole line.
    offset: u64,
    values: BTreeMap<String, Vec<[f64; 2]>>,
    frames: f64,
}

impl Metrics {
    pub(crate) fn of(run: &Path) -> Self {
        Self {
            path: run.join("metrics.jsonl"),
            ..Self::default()
        }
    }

    /// Reads what was written since the last time. Another file of that name, or one that became shorter, is read anew;
    /// one that is not there has no values.
    pub(crate) fn refresh(&mut self) -> std::io::Result<()> {
        let Ok(mut file) = File::open(&self.path) else {
            self.forget(0);
            return Ok(());
        };
        let found = file.metadata()?;
        if found.ino() != self.inode || found.len() < self.offset {
            self.forget(found.ino());
        }
        file.seek(SeekFrom::Start(self.offset))?;
        let mut lines = BufReader::new(file);
        let mut line = Vec::new();
        loop {
            line.clear();
            let read = lines.read_until(b'\n', &mut line)?;
            // A line that is being written comes next time.
            if line.last() != Some(&b'\n') {
                return Ok(());
            }
            self.offset += read as u64;
            self.take(&line);
        }
    }

    /// Begins anew, with the file `inode`.
    fn forget(&mut self, inode: u64) {
        *self = Self {
            path: std::mem::take(&mut self.path),
            inode,
            ..Self::default()
        };
    }

    fn take(&mut self, line: &[u8]) {
        let Ok(values) = serde_json::from_slice::<BTreeMap<String, Option<f64>>>(line) else {
            return;
        };
        let Some(Some(frames)) = values.get("frames").copied() else {
            return;
        };
        self.frames = self.frames.max(frames);
        for (name, value) in values {
            let Some(value) = value.filter(|_| name != "frames" && name != "time") else {
                continue;
            };
            self.values.entry(name).or_default().push([frames, value]);
        }
    }

    pub(crate) fn frames(&self) -> f64 {
        self.frames
    }

    pub(crate) fn names(&self) -> Vec<String> {
        self.values.keys().cloned().collect()
    }

    pub(crate) fn series(&self, metric: &str) -> Series {
        let all = self.values.get(metric).map_or(&[][..], Vec::as_slice);
        let neighbours = all.len().div_ceil(POINTS).max(1);
        let mean = |points: &[[f64; 2]]| {
            let sum = points.iter().fold([0.0; 2], |sum, point| {
                [sum[0] + point[0], sum[1] + point[1]]
            });
            sum.map(|sum| sum / points.len() as f64)
        };
        Series {
            points: all.chunks(neighbours).map(mean).collect(),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::fs::{self, OpenOptions};
    use std::io::Write;

    use super::*;

    #[test]
    fn a_growing_file_is_read_line_by_line_and_a_shorter_one_anew() {
        let run = tempfile::tempdir().unwrap();
        let path = run.path().join("metrics.jsonl");
        let mut metrics = Metrics::of(run.path());
        metrics.refresh().unwrap();
        assert_eq!(metrics.names(), Vec::<String>::new());

        fs::write(
            &path,
            "{\"frames\":10,\"time\":1.0,\"loss\":3.0,\"nan\":null}\n{\"frames\":20,\"lo",
        )
        .unwrap();
        metrics.refresh().unwrap();
        assert_eq!(metrics.series("loss").points, [[10.0, 3.0]]);
        let append = |text: &str| {
            let mut file = OpenOptions::new().append(true).open(&path).unwrap();
            file.write_all(text.as_bytes()).unwrap();
        };
        append("ss\":2.0}\nnot a line\n{\"frames\":30,\"loss\":1.0}\n");
        metrics.refresh().unwrap();
        assert_eq!(
            metrics.series("loss").points,
            [[10.0, 3.0], [20.0, 2.0], [30.0, 1.0]]
        );
        assert_eq!(
            (metrics.frames(), metrics.names()),
            (30.0, vec!["loss".to_owned()])
        );

        fs::write(&path, "{\"frames\":10,\"loss\":9.0}\n").unwrap();
        metrics.refresh().unwrap();
        assert_eq!(metrics.series("loss").points, [[10.0, 9.0]]);

        // A learner that resumes puts a cut file in its place, which may have grown past the old one meanwhile.
        let cut = run.path().join("metrics.jsonl.tmp");
        let lines = "{\"frames\":5,\"loss\":8.0}\n{\"frames\":10,\"loss\":7.0}\n";
        fs::write(&cut, lines).unwrap();
        fs::rename(&cut, &path).unwrap();
        metrics.refresh().unwrap();
        assert_eq!(metrics.series("loss").points, [[5.0, 8.0], [10.0, 7.0]]);

        fs::remove_file(&path).unwrap();
        metrics.refresh().unwrap();
        assert!(metrics.names().is_empty());
    }

    #[test]
    fn many_points_become_means_of_neighbours() {
        let mut metrics = Metrics::default();
        for index in 0..2_500 {
            metrics.take(format!("{{\"frames\":{index},\"x\":{}}}", 2 * index).as_bytes());
        }
        let points = metrics.series("x").points;
        assert_eq!(points.len(), 834);
        assert_eq!(points[0], [1.0, 2.0]);
        assert!(metrics.series("unknown").points.is_empty());
    }
}
