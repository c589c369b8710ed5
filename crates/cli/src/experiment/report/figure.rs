//! Curves of several seeds as median and interquartile range.

use std::path::Path;

use anyhow::anyhow;
use plotters::prelude::*;

/// Places at which curves are compared.
const PLACES: usize = 80;

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

/// One method over environment frames.
#[derive(Debug, PartialEq)]
pub(super) struct Band {
    name: String,
    /// Frames, lower quartile, median, upper quartile.
    places: Vec<[f64; 4]>,
}

/// Quartiles of `curves` where they have values; none where there are no curves.
pub(super) fn band(name: &str, curves: &[Vec<(f64, f64)>]) -> Option<Band> {
    let whole: Vec<&Vec<(f64, f64)>> = curves.iter().filter(|curve| !curve.is_empty()).collect();
    let ends = whole
        .iter()
        .map(|curve| (curve[0].0, curve[curve.len() - 1].0));
    let (first, last) = ends.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))?;
    let places = (0..=PLACES).filter_map(|place| {
        let frames = first + (last - first) * place as f64 / PLACES as f64;
        let mut values: Vec<f64> = whole.iter().filter_map(|curve| at(curve, frames)).collect();
        values.sort_by(f64::total_cmp);
        let [low, middle, high] = [0.25, 0.5, 0.75].map(|share| quantile(&values, share));
        Some([frames, low?, middle?, high?])
    });
    Some(Band {
        name: name.to_owned(),
        places: places.collect(),
    })
}

/// The value at `frames` by interpolation; none outside of the curve.
fn at(curve: &[(f64, f64)], frames: f64) -> Option<f64> {
    let after = curve.partition_point(|point| point.0 < frames);
    let &(x1, y1) = curve.get(after)?;
    if x1 == frames {
        return Some(y1);
    }
    let &(x0, y0) = curve.get(after.checked_sub(1)?)?;
    Some(y0 + (y1 - y0) * (frames - x0) / (x1 - x0))
}

/// Of sorted values, by interpolation.
fn quantile(values: &[f64], share: f64) -> Option<f64> {
    let place = share * values.len().checked_sub(1)? as f64;
    let (low, high) = (place.floor() as usize, place.ceil() as usize);
    Some(values[low] + (values[high] - values[low]) * place.fract())
}

/// Draws all methods into one picture.
pub(super) fn draw(out: &Path, metric: &str, bands: &[Band]) -> anyhow::Result<()> {
    let places = || bands.iter().flat_map(|band| &band.places);
    let most = places().map(|place| place[0]).fold(1.0, f64::max);
    let low = places().map(|place| place[1]).fold(f64::MAX, f64::min);
    let high = places().map(|place| place[3]).fold(f64::MIN, f64::max);
    let (low, high) = if low > high { (0.0, 1.0) } else { (low, high) };
    let margin = 0.05 * (high - low).max(1e-3);
    let failed = |error: &dyn std::fmt::Display| anyhow!("cannot draw {}: {error}", out.display());
    let root = SVGBackend::new(out, (900, 480)).into_drawing_area();
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
        .y_desc(metric)
        .draw()
        .map_err(|e| failed(&e))?;
    for (index, band) in bands.iter().enumerate() {
        let color = COLORS[index % COLORS.len()];
        let upper = band.places.iter().map(|place| (place[0], place[3]));
        let lower = band.places.iter().rev().map(|place| (place[0], place[1]));
        let area = Polygon::new(upper.chain(lower).collect::<Vec<_>>(), color.mix(0.15));
        chart.draw_series([area]).map_err(|e| failed(&e))?;
        let median = band.places.iter().map(|place| (place[0], place[2]));
        chart
            .draw_series(LineSeries::new(median, color.stroke_width(2)))
            .map_err(|e| failed(&e))?
            .label(&band.name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], color.stroke_width(2)));
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
mod tests {
    use super::*;

    #[test]
    fn a_band_has_the_quartiles_of_the_curves_that_reach_there() {
        let curves = [
            vec![(0.0, 0.0), (80.0, 80.0)],
            vec![(0.0, 10.0), (80.0, 90.0)],
            vec![(0.0, 40.0), (40.0, 80.0)],
        ];
        let band = band("x", &curves).expect("there are curves");
        assert_eq!(band.places[0], [0.0, 5.0, 10.0, 25.0]);
        assert_eq!(band.places[40], [40.0, 45.0, 50.0, 65.0]);
        assert_eq!(band.places[60], [60.0, 62.5, 65.0, 67.5], "two of them");
        assert_eq!(super::band("x", &[Vec::new()]), None);
    }
}
