//! Curves of several seeds as median and interquartile range.

use crate::chart::Line;

/// Places at which curves are compared.
const PLACES: usize = 80;

/// Median and quartiles of `curves`, each `(frames, value)`, where they have values; none where there are no curves.
pub(super) fn summary(name: &str, curves: &[Vec<(f64, f64)>]) -> Option<Line> {
    let whole: Vec<&Vec<(f64, f64)>> = curves.iter().filter(|curve| !curve.is_empty()).collect();
    let ends = whole
        .iter()
        .map(|curve| (curve[0].0, curve[curve.len() - 1].0));
    let (first, last) = ends.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))?;
    let mut line = Line {
        name: name.to_owned(),
        points: Vec::new(),
        band: Vec::new(),
    };
    for place in 0..=PLACES {
        let frames = first + (last - first) * place as f64 / PLACES as f64;
        let mut values: Vec<f64> = whole.iter().filter_map(|curve| at(curve, frames)).collect();
        values.sort_by(f64::total_cmp);
        let quartiles = [0.25, 0.5, 0.75].map(|share| quantile(&values, share));
        if let [Some(low), Some(middle), Some(high)] = quartiles {
            line.points.push((frames, middle));
            line.band.push((frames, low, high));
        }
    }
    Some(line)
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
        let line = summary("x", &curves).expect("there are curves");
        let place = |index: usize| (line.points[index], line.band[index]);
        assert_eq!(place(0), ((0.0, 10.0), (0.0, 5.0, 25.0)));
        assert_eq!(place(40), ((40.0, 50.0), (40.0, 45.0, 65.0)));
        assert_eq!(place(60), ((60.0, 65.0), (60.0, 62.5, 67.5)), "two of them");
        assert_eq!(summary("x", &[Vec::new()]), None);
    }
}
