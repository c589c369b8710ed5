//! Day and night: what colours things have, and how light falls on them.

use super::camera::ViewPoint;
use super::colour::{Rgb, mix, scale};

/// The time of day.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Light {
    Day,
    Night,
}

/// Street lamps stand this far apart, alternating between the sides.
pub(super) const LAMP_EVERY_M: f64 = 40.0;

/// Which way a face looks; what is lit by headlights must face them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Facing {
    Ground,
    Camera,
    Side,
    Up,
}

impl Light {
    pub(super) fn zenith(self) -> Rgb {
        match self {
            Self::Day => [0.27, 0.50, 0.86],
            Self::Night => [0.01, 0.015, 0.045],
        }
    }

    /// Also the colour of distance.
    pub(super) fn horizon(self) -> Rgb {
        match self {
            Self::Day => [0.76, 0.86, 0.95],
            Self::Night => [0.06, 0.07, 0.13],
        }
    }

    pub(super) fn cloud(self) -> Rgb {
        match self {
            Self::Day => [1.0, 1.0, 1.0],
            Self::Night => [0.10, 0.11, 0.16],
        }
    }

    pub(super) fn far_mountain(self) -> Rgb {
        match self {
            Self::Day => [0.49, 0.58, 0.72],
            Self::Night => [0.035, 0.04, 0.075],
        }
    }

    pub(super) fn near_hill(self) -> Rgb {
        match self {
            Self::Day => [0.36, 0.50, 0.42],
            Self::Night => [0.02, 0.028, 0.04],
        }
    }

    fn visibility_m(self) -> f32 {
        match self {
            Self::Day => 420.0,
            Self::Night => 260.0,
        }
    }

    /// Share of a colour that is left after `ahead` metres of air.
    pub(super) fn clearness(self, ahead: f32) -> f32 {
        (-ahead / self.visibility_m()).exp()
    }

    /// `colour` as it reaches the camera over `ahead` metres of air.
    pub(super) fn through_air(self, colour: Rgb, ahead: f32) -> Rgb {
        mix(self.horizon(), colour, self.clearness(ahead))
    }

    /// `albedo` at `point` lit by sun or headlights and lamps, and seen through the air.
    pub(super) fn shade(self, albedo: Rgb, point: ViewPoint, facing: Facing) -> Rgb {
        self.through_air(self.lit(albedo, point, facing), point[2])
    }

    /// `albedo` at `point` lit by sun or headlights.
    pub(super) fn lit(self, albedo: Rgb, [right, _, ahead]: ViewPoint, facing: Facing) -> Rgb {
        let strength = match (self, facing) {
            (Self::Day, Facing::Ground) => 1.0,
            (Self::Day, Facing::Camera) => 0.92,
            (Self::Day, Facing::Side) => 0.70,
            (Self::Day, Facing::Up) => 1.08,
            (Self::Night, Facing::Ground) => NIGHT + headlights(right, ahead),
            (Self::Night, Facing::Camera) => 1.5 * NIGHT + headlights(right, ahead),
            (Self::Night, Facing::Side) => 1.5 * NIGHT + 0.45 * headlights(right, ahead),
            (Self::Night, Facing::Up) => 2.0 * NIGHT + 0.25 * headlights(right, ahead),
        };
        scale(albedo, strength)
    }

    /// By what factor street lamps brighten things at road position `s`, less one.
    pub(super) fn lamps(self, s: f64) -> f32 {
        match self {
            Self::Day => 0.0,
            Self::Night => {
                let lamp = ((s / LAMP_EVERY_M + 0.5) as i64) as f64 * LAMP_EVERY_M;
                let part = ((s - lamp) / 11.0) as f32;
                let spread = 1.0 + part * part;
                LAMPLIGHT / (spread * spread)
            }
        }
    }
}

/// Share of its daylight brightness that a thing keeps in the dark.
const NIGHT: f32 = 0.15;
/// How much brighter things are below a street lamp, relative to their share of [`NIGHT`].
const LAMPLIGHT: f32 = 0.9;

/// Brightness from the ego's headlights, aimed straight ahead.
fn headlights(right: f32, ahead: f32) -> f32 {
    if ahead <= 0.0 {
        return 0.0;
    }
    let off_axis = right / (0.30 * ahead + 1.2);
    let far = ahead / 26.0;
    let spread = 1.0 + off_axis * off_axis;
    0.8 / ((1.0 + far * far) * spread * spread)
}
