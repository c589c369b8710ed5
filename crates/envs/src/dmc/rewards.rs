//! How near a measurement is to where a task wants it: dm_control's `tolerance`.

use std::ops::RangeInclusive;

/// How the value falls beyond the bounds; the argument is the value at a distance of one margin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Falloff {
    /// `exp(-(k d)^2 / 2)`, never 0.
    Gaussian(f64),
    /// `1 - k d`, not below 0.
    Linear(f64),
    /// `1 - (k d)^2`, not below 0.
    Quadratic(f64),
}

/// What tasks that name no falloff use.
pub(super) const DEFAULT: Falloff = Falloff::Gaussian(0.1);

impl Falloff {
    /// The value at `distance`, counted in margins.
    fn at(self, distance: f64) -> f64 {
        match self {
            Self::Gaussian(at_margin) => {
                let scaled = distance * (-2.0 * at_margin.ln()).sqrt();
                (-0.5 * (scaled * scaled)).exp()
            }
            Self::Linear(at_margin) => 1.0 - (distance * (1.0 - at_margin)).min(1.0),
            Self::Quadratic(at_margin) => {
                let scaled = (distance * (1.0 - at_margin).sqrt()).min(1.0);
                1.0 - scaled * scaled
            }
        }
    }
}

/// 1 where `x` is within `bounds`, 0 elsewhere.
pub(super) fn within(x: f64, bounds: RangeInclusive<f64>) -> f64 {
    f64::from(u8::from(bounds.contains(&x)))
}

/// 1 where `x` is within `bounds`, falling beyond them; `margin` is positive.
pub(super) fn near(x: f64, bounds: RangeInclusive<f64>, margin: f64, falloff: Falloff) -> f64 {
    if bounds.contains(&x) {
        return 1.0;
    }
    let distance = if x < *bounds.start() {
        bounds.start() - x
    } else {
        x - bounds.end()
    };
    falloff.at(distance / margin)
}

/// [`near`] for measurements that should be at least `least`.
pub(super) fn at_least(x: f64, least: f64, margin: f64, falloff: Falloff) -> f64 {
    near(x, least..=f64::INFINITY, margin, falloff)
}

/// Mean over the actuators of how small their controls are: 1 at rest, 0 at full force.
pub(super) fn small_control(control: &[f64]) -> f64 {
    let sum: f64 = control
        .iter()
        .map(|&u| near(u, 0.0..=0.0, 1.0, Falloff::Quadratic(0.0)))
        .sum();
    sum / control.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(actual: f64, expected: f64) {
        assert!(
            (actual - expected).abs() < 1e-15,
            "{actual} is not {expected}"
        );
    }

    // Expected values are printed by dm_control.utils.rewards.tolerance of dm_control 1.0.50.

    #[test]
    fn gaussian_matches_dm_control() {
        close(at_least(1.0, 1.2, 0.6, DEFAULT), 0.7742636826811271);
        close(near(0.2, 0.0..=0.0, 2.0, DEFAULT), 0.9772372209558107);
        close(near(2.3, 0.6..=2.0, 0.7, DEFAULT), 0.6551285568595512);
        close(at_least(1.2, 1.2, 0.6, DEFAULT), 1.0);
    }

    #[test]
    fn linear_matches_dm_control() {
        let half = Falloff::Linear(0.5);
        close(at_least(0.6, 1.0, 0.5, half), 0.6);
        close(at_least(0.1, 1.0, 0.5, half), 0.09999999999999998);
        let zero = Falloff::Linear(0.0);
        close(at_least(7.0, 10.0, 10.0, zero), 0.7);
        close(at_least(-3.0, 10.0, 10.0, zero), 0.0);
    }

    #[test]
    fn quadratic_matches_dm_control_on_both_sides() {
        let falloff = Falloff::Quadratic(0.0);
        for (x, expected) in [(0.6, 0.64), (-0.6, 0.64), (1.5, 0.0), (0.0, 1.0)] {
            close(near(x, 0.0..=0.0, 1.0, falloff), expected);
        }
        close(small_control(&[0.6, -0.6, 1.0, 0.0]), 0.57);
    }

    #[test]
    fn without_a_margin_bounds_are_sharp_and_inclusive() {
        assert_eq!(
            [0.59, 0.6, 2.0, 2.5].map(|x| within(x, 0.6..=2.0)),
            [0.0, 1.0, 1.0, 0.0]
        );
    }

    #[test]
    fn nan_is_never_rewarded() {
        assert_eq!(within(f64::NAN, 0.0..=1.0), 0.0);
        assert!(at_least(f64::NAN, 1.0, 1.0, DEFAULT).is_nan());
    }
}
