//! Periodic functions out of sums and products alone: the standard library's sine may differ in its last
//! bit from one machine to the next.

/// `sin(2 pi turns)`, within 1e-5.
pub(crate) fn sine(turns: f32) -> f32 {
    let around = turns - (turns + 0.5).floor();
    // Mirrored into the quarter turns beside zero, where the series converges fast.
    let near = if around > 0.25 {
        0.5 - around
    } else if around < -0.25 {
        -0.5 - around
    } else {
        around
    };
    let square = near * near;
    near * (6.283_185_5
        + square * (-41.341_7 + square * (81.605_25 + square * (-76.705_86 + square * 42.058_69))))
}

/// Smooth step from 0 to 1 on `[0, 1]`, flat at both ends.
pub(crate) fn smooth(at: f32) -> f32 {
    let at = at.clamp(0.0, 1.0);
    at * at * (3.0 - 2.0 * at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sine_follows_the_standard_library() {
        for index in -4_000..4_000 {
            let turns = index as f32 / 1_000.0;
            let expected = (f64::from(turns) * std::f64::consts::TAU).sin();
            let error = (f64::from(sine(turns)) - expected).abs();
            assert!(error < 1e-5, "{turns}: {error}");
        }
    }

    #[test]
    fn a_smooth_step_is_flat_at_its_ends() {
        assert_eq!(
            [-1.0, 0.0, 0.5, 1.0, 9.0].map(smooth),
            [0.0, 0.0, 0.5, 1.0, 1.0]
        );
        assert!(smooth(0.01) < 0.001 && smooth(0.99) > 0.999);
    }
}
