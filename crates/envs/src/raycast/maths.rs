//! Powers, logarithms and rounding that give the same bits on every machine, which the C library does not promise.

/// The binary logarithm of a positive number, to about 1e-6.
pub(crate) fn log2(value: f32) -> f32 {
    let bits = value.to_bits();
    let mut exponent = (bits >> 23) as i32 - 127;
    let mut mantissa = f32::from_bits(bits & 0x007f_ffff | 0x3f80_0000);
    if mantissa > std::f32::consts::SQRT_2 {
        mantissa *= 0.5;
        exponent += 1;
    }
    // The series of the area tangent converges fast near one.
    let ratio = (mantissa - 1.0) / (mantissa + 1.0);
    let square = ratio * ratio;
    let series = 1.0 + square * (1.0 / 3.0 + square * (1.0 / 5.0 + square * (1.0 / 7.0)));
    exponent as f32 + 2.0 * std::f32::consts::LOG2_E * ratio * series
}

/// Two to the power of `value`, to about 1e-6 of itself; 0 below -126.
pub(crate) fn exp2(value: f32) -> f32 {
    if value < -126.0 {
        return 0.0;
    }
    let whole = floor(value.min(127.0) + 0.5);
    let x = (value.min(127.0) - whole) * std::f32::consts::LN_2;
    let series = 1.0 + x * (1.0 + x * (1.0 / 2.0 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x / 120.0))));
    f32::from_bits(((whole as i32 + 127) as u32) << 23) * series
}

/// The greatest whole number that is not above `value`, which has to fit in an `i32`. Unlike `f32::floor` it is
/// not a call of a function on the plainest processors.
pub(crate) fn floor(value: f32) -> f32 {
    let whole = value as i32 as f32;
    if whole > value { whole - 1.0 } else { whole }
}

/// `base` in `[0, 1]` to the power of `exponent >= 0`; 1 if both are 0.
pub(crate) fn power(base: f32, exponent: f32) -> f32 {
    if base <= 0.0 {
        return if exponent == 0.0 { 1.0 } else { 0.0 };
    }
    let mut whole = exponent.min(255.0) as u32;
    if whole as f32 != exponent {
        return exp2(exponent * log2(base));
    }
    let (mut result, mut square) = (1.0, base);
    while whole > 0 {
        if whole & 1 == 1 {
            result *= square;
        }
        square *= square;
        whole >>= 1;
    }
    result
}

/// The angle of the direction `(x, y)` from the x axis in `[0, 2 pi)`, to about 1e-5.
pub(crate) fn angle(y: f32, x: f32) -> f32 {
    let (low, high) = (x.abs().min(y.abs()), x.abs().max(y.abs()));
    let ratio = if high > 0.0 { low / high } else { 0.0 };
    // The half angle makes the series of the arc tangent short.
    let half = ratio / (1.0 + (1.0 + ratio * ratio).sqrt());
    let square = half * half;
    let series =
        1.0 - square * (1.0 / 3.0 - square * (1.0 / 5.0 - square * (1.0 / 7.0 - square / 9.0)));
    let mut angle = 2.0 * half * series;
    if y.abs() > x.abs() {
        angle = std::f32::consts::FRAC_PI_2 - angle;
    }
    if x < 0.0 {
        angle = std::f32::consts::PI - angle;
    }
    if y < 0.0 {
        angle = std::f32::consts::TAU - angle;
    }
    angle
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn powers_are_those_of_double_precision() {
        for step in 1..=200 {
            let base = step as f32 / 200.0;
            for exponent in [0.5, 1.0, 10.0, 38.4, 64.0, 128.0] {
                let exact = f64::from(base).powf(f64::from(exponent));
                let error = (f64::from(power(base, exponent)) - exact).abs();
                assert!(
                    error < 1e-5 * exact + 1e-9,
                    "{base} to the {exponent}: off by {error}"
                );
            }
        }
        assert_eq!(power(0.0, 0.0), 1.0);
        assert_eq!(power(0.0, 64.0), 0.0);
        assert_eq!(power(1.0, 64.0), 1.0);
    }

    #[test]
    fn floor_rounds_down() {
        for value in [-2.0, -1.5, -0.25, -0.0, 0.0, 0.75, 1.0, 7.999] {
            assert_eq!(floor(value), value.floor(), "{value}");
        }
    }

    #[test]
    fn angles_go_once_around() {
        for step in 0..100 {
            let exact = f64::from(step) * std::f64::consts::TAU / 100.0;
            let found = angle(exact.sin() as f32 * 3.0, exact.cos() as f32 * 3.0);
            assert!((f64::from(found) - exact).abs() < 1e-4, "{exact}: {found}");
        }
        assert_eq!(angle(0.0, 0.0), 0.0);
    }
}
