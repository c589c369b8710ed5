//! `isodream report`: learning curves of one or more runs as a picture.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, ensure};
use clap::Args;
use plotters::prelude::*;

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

/// Curves, in their order.
const COLORS: [RGBColor; 6] = [
    RGBColor(31, 119, 180),
    RGBColor(214, 99, 0),
    RGBColor(34, 139, 60),
    RGBColor(180, 40, 60),
    RGBColor(120, 80, 170),
    RGBColor(90, 90, 90),
];

/// One run's values over environment frames; values at the same frames are averaged.
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
    draw(&args.out, &label, &curves, &levels)
        .with_context(|| format!("cannot draw {}", args.out.display()))
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
        let mut points: Vec<(f64, f64, f64)> = Vec::new();
        for line in text.lines() {
            let line: serde_json::Value = serde_json::from_str(line)
                .with_context(|| format!("{} has a damaged line", path.display()))?;
            let (Some(frames), Some(value)) = (line["frames"].as_f64(), line[metric].as_f64())
            else {
                continue;
            };
            match points.last_mut() {
                // Episodes of one evaluation arrive one by one, within a few frames of each other.
                Some((at, sum, count)) if frames - *at < 1_000.0 => {
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

fn draw(out: &Path, label: &str, curves: &[Curve], levels: &[(String, f64)]) -> anyhow::Result<()> {
    let all = || curves.iter().flat_map(|curve| &curve.points);
    let most = all().map(|p| p.0).fold(1.0, f64::max);
    let values = || {
        all()
            .map(|p| p.1)
            .chain(levels.iter().map(|(_, value)| *value))
    };
    let (low, high) = (
        values().fold(f64::MAX, f64::min),
        values().fold(f64::MIN, f64::max),
    );
    let margin = 0.05 * (high - low).max(1.0);

    let root = SVGBackend::new(out, (900, 540)).into_drawing_area();
    let failed = |error: &dyn std::fmt::Display| anyhow!("{error}");
    root.fill(&WHITE).map_err(|e| failed(&e))?;
    let mut chart = ChartBuilder::on(&root)
        .margin(16)
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(0.0..most, low - margin..high + margin)
        .map_err(|e| failed(&e))?;
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_desc("environment frames")
        .y_desc(label)
        .draw()
        .map_err(|e| failed(&e))?;
    for (index, curve) in curves.iter().enumerate() {
        let color = COLORS[index % COLORS.len()].to_rgba();
        chart
            .draw_series(LineSeries::new(
                curve.points.iter().copied(),
                color.stroke_width(2),
            ))
            .map_err(|e| failed(&e))?
            .label(&curve.name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], color.stroke_width(2)));
    }
    for (index, (name, value)) in levels.iter().enumerate() {
        let color = BLACK.mix(0.8 / (index + 1) as f64);
        chart
            .draw_series(LineSeries::new([(0.0, *value), (most, *value)], color))
            .map_err(|e| failed(&e))?
            .label(format!("{name} {value:.0}"))
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], color));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::LowerRight)
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK)
        .draw()
        .map_err(|e| failed(&e))?;
    root.present().map_err(|e| failed(&e))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

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
