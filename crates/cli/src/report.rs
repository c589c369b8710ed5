//! `isodream report`: learning curves of one or more runs as a picture.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::Args;
use isodream_core::Config;

use crate::chart::{Line, draw};

/// Options of `isodream report`.
#[derive(Debug, Args)]
pub(crate) struct ReportArgs {
    /// Run directories, for example one per seed
    #[arg(required = true)]
    runs: Vec<PathBuf>,
    /// The picture (SVG)
    #[arg(long, default_value = "learning_curve.svg")]
    out: PathBuf,
    /// Metric to draw
    #[arg(long, default_value = "eval/score")]
    metric: String,
    /// Newest points that each drawn value is the mean of; single episodes scatter widely
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    smooth: u16,
    /// Levels to draw beside the curves, for example keep_lane=107.8; may be repeated
    #[arg(long, value_name = "NAME=VALUE")]
    level: Vec<String>,
}

/// One run's values over environment frames; values at the same frames, and those of one evaluation, are averaged.
pub(crate) struct Curve {
    name: String,
    pub(crate) points: Vec<(f64, f64)>,
}

/// Runs the command.
pub(crate) fn run(args: &ReportArgs) -> anyhow::Result<()> {
    let curves: Vec<Curve> = args
        .runs
        .iter()
        .map(|run| Ok(Curve::read(run, &args.metric)?.smoothed(usize::from(args.smooth))))
        .collect::<anyhow::Result<_>>()?;
    let levels: Vec<(String, f64)> = args
        .level
        .iter()
        .map(|text| level(text))
        .collect::<Result<_, _>>()?;
    let label = match args.smooth {
        1 => args.metric.clone(),
        window => format!("{}, mean of {window}", args.metric),
    };
    let lines: Vec<Line> = curves
        .into_iter()
        .map(|curve| Line {
            name: curve.name,
            points: curve.points,
            band: Vec::new(),
        })
        .collect();
    draw(&args.out, &label, &lines, &levels)
}

/// Frames up to which values are of one point: the episodes of an evaluation arrive one by one.
fn distance(run: &Path, metric: &str) -> anyhow::Result<f64> {
    let config = run.join("config.toml");
    if !metric.starts_with("eval/") || !config.exists() {
        return Ok(0.0);
    }
    let interval = Config::from_file(&config)?.actor.evaluate_interval_frames;
    Ok(interval as f64 / 2.0)
}

fn level(text: &str) -> anyhow::Result<(String, f64)> {
    let parsed = text
        .split_once('=')
        .and_then(|(name, value)| Some((name.to_owned(), value.parse().ok()?)));
    parsed.with_context(|| {
        format!("--level {text}: expected name=value, for example keep_lane=107.8")
    })
}

impl Curve {
    pub(crate) fn read(run: &Path, metric: &str) -> anyhow::Result<Self> {
        let path = run.join("metrics.jsonl");
        let text = std::fs::read_to_string(&path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        let apart = distance(run, metric)?;
        let mut points: Vec<(f64, f64, f64)> = Vec::new();
        // A run that is killed, or is writing, may end in half a line.
        for (index, line) in text.split_inclusive('\n').enumerate() {
            if !line.ends_with('\n') {
                break;
            }
            let line: serde_json::Value = serde_json::from_str(line).with_context(|| {
                format!(
                    "line {} of {} is damaged; remove it",
                    index + 1,
                    path.display()
                )
            })?;
            let (Some(frames), Some(value)) = (line["frames"].as_f64(), line[metric].as_f64())
            else {
                continue;
            };
            match points.last_mut() {
                Some((at, sum, count)) if (frames - *at).abs() <= apart => {
                    *sum += value;
                    *count += 1.0;
                }
                _ => points.push((frames, value, 1.0)),
            }
        }
        ensure!(
            !points.is_empty(),
            "{} has no values of `{metric}`",
            path.display()
        );
        Ok(Self {
            name: run.file_name().map_or_else(
                || run.display().to_string(),
                |name| name.to_string_lossy().into_owned(),
            ),
            points: points
                .into_iter()
                .map(|(frames, sum, count)| (frames, sum / count))
                .collect(),
        })
    }

    /// Every value replaced by the mean of the newest `window` up to it.
    pub(crate) fn smoothed(self, window: usize) -> Self {
        let points = &self.points;
        let mean = |index: usize| {
            let newest = &points[(index + 1).saturating_sub(window)..=index];
            newest.iter().map(|point| point.1).sum::<f64>() / newest.len() as f64
        };
        let points = points
            .iter()
            .enumerate()
            .map(|(i, &(frames, _))| (frames, mean(i)));
        Self {
            points: points.collect(),
            name: self.name,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn episodes_of_an_evaluation_are_one_point_and_half_a_line_is_none() {
        let run = tempfile::tempdir().unwrap();
        let lines = [
            (4_000, "eval/score", 10.0),
            (4_010, "train/loss/model", 3.0),
            (4_020, "train/loss/model", 1.0),
            (4_900, "eval/score", 20.0),
            (8_000, "eval/score", 60.0),
        ]
        .map(|(frames, name, value)| format!("{{\"frames\":{frames},\"{name}\":{value}}}\n"));
        let text = format!("{}{{\"frames\":8100,\"ev", lines.concat());
        std::fs::write(run.path().join("metrics.jsonl"), text).unwrap();
        let mut config = Config::default();
        config.actor.evaluate_interval_frames = 4_000;
        std::fs::write(run.path().join("config.toml"), config.to_toml()).unwrap();
        let points = |metric| Curve::read(run.path(), metric).unwrap().points;
        assert_eq!(points("eval/score"), [(4_000.0, 15.0), (8_000.0, 60.0)]);
        let losses = [(4_010.0, 3.0), (4_020.0, 1.0)];
        assert_eq!(
            points("train/loss/model"),
            losses,
            "each is a point of its own"
        );
    }

    #[test]
    fn a_smoothed_value_is_the_mean_of_the_newest_points() {
        let curve = Curve {
            name: "run".into(),
            points: vec![(1.0, 2.0), (2.0, 4.0), (3.0, 9.0), (4.0, -4.0)],
        };
        let smoothed = curve.smoothed(3).points;
        assert_eq!(smoothed, [(1.0, 2.0), (2.0, 3.0), (3.0, 5.0), (4.0, 3.0)]);
    }
}
