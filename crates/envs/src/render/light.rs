//! Day and night: what colours things have, and how light falls on them.

use super::camera::ViewPoint;
use super::colour::{Rgb, mix};

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

/// The colours of sky and distance, and the strength of what shines.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Lighting {
    pub(super) light: Light,
    pub(super) zenith: Rgb,
    /// Also the colour of distance.
    pub(super) horizon: Rgb,
    pub(super) cloud: Rgb,
    pub(super) far_mountain: Rgb,
    pub(super) near_hill: Rgb,
    /// How much more of the sky clouds cover than on a fine day, 0 to 1.
    pub(super) cloudiness: f64,
    pub(super) visibility_m: f32,
    /// Sunlight relative to that of a fine day.
    pub(super) sun: Rgb,
    /// Share of its daylight brightness that a thing keeps in the dark.
    pub(super) dark: f32,
}

impl Lighting {
    /// The light of a fine day or night.
    pub(super) fn of(light: Light) -> Self {
        match light {
            Light::Day => Self {
                light,
                zenith: [0.27, 0.50, 0.86],
                horizon: [0.76, 0.86, 0.95],
                cloud: [1.0, 1.0, 1.0],
                far_mountain: [0.49, 0.58, 0.72],
                near_hill: [0.36, 0.50, 0.42],
                cloudiness: 0.0,
                visibility_m: 420.0,
                sun: [1.0; 3],
                dark: 1.0,
            },
            Light::Night => Self {
                light,
                zenith: [0.01, 0.015, 0.045],
                horizon: [0.06, 0.07, 0.13],
                cloud: [0.10, 0.11, 0.16],
                far_mountain: [0.035, 0.04, 0.075],
                near_hill: [0.02, 0.028, 0.04],
                cloudiness: 0.0,
                visibility_m: 260.0,
                sun: [1.0; 3],
                dark: 0.15,
            },
        }
    }

    /// Share of a colour that is left after `ahead` metres of air.
    pub(super) fn clearness(&self, ahead: f32) -> f32 {
        (-ahead / self.visibility_m).exp()
    }

    /// `colour` as it reaches the camera over `ahead` metres of air.
    pub(super) fn through_air(&self, colour: Rgb, ahead: f32) -> Rgb {
        mix(self.horizon, colour, self.clearness(ahead))
    }

    /// `albedo` at `point` lit by sun or headlights and lamps, and seen through the air.
    pub(super) fn shade(&self, albedo: Rgb, point: ViewPoint, facing: Facing) -> Rgb {
        self.through_air(self.lit(albedo, point, facing), point[2])
    }

    /// `albedo` at `point` lit by sun or headlights.
    #[inline]
    pub(super) fn lit(&self, albedo: Rgb, [right, _, ahead]: ViewPoint, facing: Facing) -> Rgb {
        let strength = match (self.light, facing) {
            (Light::Day, Facing::Ground) => 1.0,
            (Light::Day, Facing::Camera) => 0.92,
            (Light::Day, Facing::Side) => 0.70,
            (Light::Day, Facing::Up) => 1.08,
            (Light::Night, Facing::Ground) => self.dark + headlights(right, ahead),
            (Light::Night, Facing::Camera) => 1.5 * self.dark + headlights(right, ahead),
            (Light::Night, Facing::Side) => 1.5 * self.dark + 0.45 * headlights(right, ahead),
            (Light::Night, Facing::Up) => 2.0 * self.dark + 0.25 * headlights(right, ahead),
        };
        std::array::from_fn(|i| albedo[i] * strength * self.sun[i])
    }

    /// By what factor street lamps brighten things at road position `s`, less one.
    pub(super) fn lamps(&self, s: f64) -> f32 {
        match self.light {
            Light::Day => 0.0,
            Light::Night => {
                let lamp = ((s / LAMP_EVERY_M + 0.5) as i64) as f64 * LAMP_EVERY_M;
                let part = ((s - lamp) / 11.0) as f32;
                let spread = 1.0 + part * part;
                LAMPLIGHT / (spread * spread)
            }
        }
    }
}

/// How much brighter things are below a street lamp, relative to what they keep in the dark.
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
