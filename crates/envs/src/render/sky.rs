//! The sky above the horizon, with mountains that turn with the heading and never come nearer.

use super::camera::Camera;
use super::colour::{Rgb, mix};
use super::light::Lighting;

/// Two crossing waves of cloud: angular frequency in azimuth and in elevation.
const CLOUD_WAVES: [[f64; 2]; 2] = [[6.0, 9.0], [11.0, -23.0]];

/// Fills the rows above the horizon of `image`, a row-major picture of `size` x `size`.
pub(super) fn draw(camera: &Camera, light: &Lighting, image: &mut [Rgb], size: usize) {
    let rows: Vec<Row> = (0..size.div_ceil(2))
        .map(|y| Row::new(camera, light, y))
        .collect();
    for x in 0..size {
        let offset = (x as f64 + 0.5 - camera.centre) / camera.focal;
        let azimuth = camera.yaw - offset.atan();
        let waves = CLOUD_WAVES.map(|[frequency, _]| (frequency * azimuth).sin_cos());
        let (far, near) = (mountains(azimuth), hills(azimuth));
        for (y, row) in rows.iter().enumerate() {
            // How much of the pixel lies below a ridge: smooth edges without samples.
            let below =
                |ridge: f64| ((ridge - row.elevation) * camera.focal + 0.5).clamp(0.0, 1.0) as f32;
            let mut colour = mix(row.colour, light.cloud, row.clouds(waves));
            colour = mix(colour, light.far_mountain, below(far));
            image[y * size + x] = mix(colour, light.near_hill, below(near));
        }
    }
}

/// What all pixels of a row have in common.
struct Row {
    /// Tangent of the angle above the horizon.
    elevation: f64,
    colour: Rgb,
    waves: [(f64, f64); 2],
    /// How dense clouds may be at this height.
    band: f64,
    /// What the waves must add up to for a cloud.
    threshold: f64,
}

impl Row {
    fn new(camera: &Camera, light: &Lighting, y: usize) -> Self {
        let elevation = (camera.centre - y as f64 - 0.5) / camera.focal;
        let height = (elevation / 0.5).clamp(0.0, 1.0) as f32;
        Self {
            elevation,
            colour: mix(light.horizon, light.zenith, height.sqrt()),
            waves: CLOUD_WAVES.map(|[_, frequency]| (frequency * elevation).sin_cos()),
            threshold: 0.3 - 1.3 * light.cloudiness,
            band: (1.0 - ((elevation - 0.33) / 0.2).powi(2)).max(0.0),
        }
    }

    fn clouds(&self, columns: [(f64, f64); 2]) -> f32 {
        // sin(a + b) from the parts: a sine per pixel would cost more than the rest of the sky.
        let sum: f64 = (columns.iter().zip(&self.waves))
            .map(|((sin_a, cos_a), (sin_b, cos_b))| sin_a * cos_b + cos_a * sin_b)
            .sum();
        (0.45 * (sum - self.threshold).max(0.0) * self.band).min(0.8) as f32
    }
}

/// Tangent of the elevation of the far ridge. Whole periods per turn, so that the ridge closes.
fn mountains(azimuth: f64) -> f64 {
    0.085
        + 0.035 * (3.0 * azimuth + 0.4).sin()
        + 0.030 * (8.0 * azimuth + 2.0).sin()
        + 0.016 * (19.0 * azimuth + 1.0).sin()
        + 0.008 * (41.0 * azimuth).sin()
}

fn hills(azimuth: f64) -> f64 {
    0.028 + 0.014 * (5.0 * azimuth + 1.3).sin() + 0.009 * (14.0 * azimuth + 0.2).sin()
}
