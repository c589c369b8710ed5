//! Curves over environment frames as an SVG.

use std::path::Path;

use anyhow::anyhow;
use plotters::prelude::*;

/// Curves, in their order.
const COLORS: [RGBColor; 8] = [
    RGBColor(47, 111, 181),
    RGBColor(200, 85, 61),
    RGBColor(60, 141, 90),
    RGBColor(138, 90, 168),
    RGBColor(176, 138, 30),
    RGBColor(42, 140, 147),
    RGBColor(180, 74, 125),
    RGBColor(107, 111, 118),
];

/// A line and what it varies by.
#[derive(Debug, PartialEq)]
pub(crate) struct Line {
    /// For the legend.
    pub(crate) name: String,
    /// `(frames, value)`.
    pub(crate) points: Vec<(f64, f64)>,
    /// `(frames, low, high)`; empty for a line alone.
    pub(crate) band: Vec<(f64, f64, f64)>,
}

/// Draws all lines into one picture, and `levels` as horizontal ones.
pub(crate) fn draw(
    out: &Path,
    label: &str,
    lines: &[Line],
    levels: &[(String, f64)],
) -> anyhow::Result<()> {
    let points = || lines.iter().flat_map(|line| &line.points);
    let most = points().map(|point| point.0).fold(1.0, f64::max);
    let band = lines.iter().flat_map(|line| &line.band);
    let values: Vec<f64> = points()
        .map(|point| point.1)
        .chain(band.flat_map(|&(_, low, high)| [low, high]))
        .chain(levels.iter().map(|(_, value)| *value))
        .collect();
    let low = values.iter().copied().reduce(f64::min).unwrap_or(0.0);
    let high = values.iter().copied().reduce(f64::max).unwrap_or(1.0);
    let margin = 0.05 * (high - low).max(1e-3);

    let failed = |error: &dyn std::fmt::Display| anyhow!("cannot draw {}: {error}", out.display());
    let root = SVGBackend::new(out, (900, 540)).into_drawing_area();
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
        .x_label_formatter(&|frames| format!("{frames:.0}"))
        // Sums of steps like 0.1 are off in the last digit, and zero has no sign.
        .y_label_formatter(&|value| ((value * 1e6).round() / 1e6 + 0.0).to_string())
        .draw()
        .map_err(|e| failed(&e))?;
    for (index, line) in lines.iter().enumerate() {
        let color = COLORS[index % COLORS.len()];
        let upper = line.band.iter().map(|&(frames, _, high)| (frames, high));
        let lower = line
            .band
            .iter()
            .rev()
            .map(|&(frames, low, _)| (frames, low));
        let area = Polygon::new(upper.chain(lower).collect::<Vec<_>>(), color.mix(0.15));
        chart.draw_series([area]).map_err(|e| failed(&e))?;
        chart
            .draw_series(LineSeries::new(
                line.points.iter().copied(),
                color.stroke_width(2),
            ))
            .map_err(|e| failed(&e))?
            .label(&line.name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], color.stroke_width(2)));
    }
    for (index, line) in lines.iter().enumerate() {
        let color = COLORS[index % COLORS.len()];
        // A short run has one value, which is no line.
        let end = line
            .points
            .last()
            .map(|&end| Circle::new(end, 3, color.filled()));
        chart.draw_series(end).map_err(|e| failed(&e))?;
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
        .border_style(BLACK.mix(0.3))
        .draw()
        .map_err(|e| failed(&e))?;
    root.present().map_err(|e| failed(&e))?;
    Ok(())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn a_single_value_is_seen_as_well() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("a.svg");
        let line = |name: &str, points: &[(f64, f64)]| Line {
            name: name.to_owned(),
            points: points.to_vec(),
            band: Vec::new(),
        };
        let lines = [
            line("one", &[(50.0, 2.0)]),
            line("two", &[(0.0, 1.0), (100.0, 3.0)]),
        ];
        draw(&out, "score", &lines, &[("level".into(), 2.5)]).unwrap();
        let svg = std::fs::read_to_string(&out).unwrap();
        assert_eq!(svg.matches("<circle").count(), 2, "{svg}");
        for word in ["one", "two", "level 2", "environment frames", "score"] {
            assert!(svg.contains(word), "no {word}: {svg}");
        }
    }
}
