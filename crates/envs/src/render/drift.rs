//! What the weather does to the light.

use super::colour::{Rgb, mix, scale};
use super::light::{Light, Lighting};
use crate::highway::Weather;

const LOW_SUN: Rgb = [0.88, 0.70, 0.52];
const LOW_SUN_HORIZON: Rgb = [0.95, 0.80, 0.62];
const LOW_SUN_ZENITH: Rgb = [0.24, 0.36, 0.62];
const OVERCAST: Rgb = [0.56, 0.60, 0.66];
const OVERCAST_HORIZON: Rgb = [0.68, 0.71, 0.74];
const OVERCAST_CLOUD: Rgb = [0.74, 0.76, 0.79];
const NIGHT_OVERCAST: Rgb = [0.05, 0.046, 0.056];
const NIGHT_OVERCAST_HORIZON: Rgb = [0.10, 0.095, 0.12];

/// Weather in shares from 0 to 1.
struct Shares {
    low_sun: f32,
    overcast: f32,
    rain: f32,
}

impl Lighting {
    /// This light under `weather`. By night the moon stands where the sun would.
    pub(super) fn under(self, weather: &Weather) -> Self {
        let lowest = 20.0_f64.to_radians().sin();
        let height = weather.sun_altitude_deg().to_radians().sin();
        let shares = Shares {
            low_sun: ((1.0 - height) / (1.0 - lowest)) as f32,
            overcast: (weather.clouds_percent() / 60.0) as f32,
            rain: (weather.rain_percent() / 80.0) as f32,
        };
        let drifted = match self.light {
            Light::Day => self.by_day(&shares),
            Light::Night => self.by_night(&shares),
        };
        Self {
            visibility_m: self.visibility_m * (1.0 - 0.55 * shares.rain),
            cloudiness: f64::from(shares.overcast),
            ..drifted
        }
    }

    fn by_day(self, shares: &Shares) -> Self {
        let sun = mix(self.sun, LOW_SUN, shares.low_sun);
        let low = |colour, tint| mix(colour, tint, 0.7 * shares.low_sun);
        let grey = |colour, tint| mix(colour, tint, 0.85 * shares.overcast);
        let dim = (1.0 - 0.25 * shares.overcast) * (1.0 - 0.12 * shares.rain);
        Self {
            // Clouds also take the colour out of the sunlight.
            sun: scale(mix(sun, [sun[1]; 3], 0.8 * shares.overcast), dim),
            zenith: grey(low(self.zenith, LOW_SUN_ZENITH), OVERCAST),
            horizon: grey(low(self.horizon, LOW_SUN_HORIZON), OVERCAST_HORIZON),
            cloud: grey(low(self.cloud, LOW_SUN_HORIZON), OVERCAST_CLOUD),
            far_mountain: grey(low(self.far_mountain, LOW_SUN_ZENITH), OVERCAST),
            near_hill: scale(self.near_hill, dim * (1.0 - 0.2 * shares.low_sun)),
            ..self
        }
    }

    fn by_night(self, shares: &Shares) -> Self {
        let grey = |colour, tint| mix(colour, tint, 0.8 * shares.overcast);
        let moon = (1.25 - 0.45 * shares.low_sun) * (1.0 - 0.3 * shares.overcast);
        Self {
            dark: self.dark * moon,
            zenith: grey(self.zenith, NIGHT_OVERCAST),
            horizon: grey(self.horizon, NIGHT_OVERCAST_HORIZON),
            ..self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::highway::weather;

    fn brightness(colour: Rgb) -> f32 {
        colour.iter().sum()
    }

    #[test]
    fn a_low_sun_is_warm_and_clouds_are_grey() {
        let day = Lighting::of(Light::Day);
        let evening = day.under(&weather(false, -250.0));
        assert!(evening.sun[0] > 1.4 * evening.sun[2]);
        let overcast = day.under(&weather(true, 20.0));
        assert!(overcast.zenith[2] - overcast.zenith[0] < 0.3 * (day.zenith[2] - day.zenith[0]));
        assert!(brightness(overcast.sun) < 0.9 * brightness(day.sun));
    }

    #[test]
    fn rain_shortens_the_view_by_day_and_night() {
        for light in [Light::Day, Light::Night] {
            let clear = Lighting::of(light);
            let rain = clear.under(&weather(true, 80.0));
            assert!(rain.clearness(100.0) < 0.8 * clear.clearness(100.0));
        }
    }

    #[test]
    fn a_high_sun_without_clouds_is_the_plain_day() {
        let day = Lighting::of(Light::Day);
        assert_eq!(day.under(&weather(true, -250.0)), day);
    }

    #[test]
    fn nights_stay_dark() {
        for storm in [-250.0, 20.0, 100.0] {
            let night = Lighting::of(Light::Night).under(&weather(true, storm));
            assert!(brightness(night.zenith) < 0.3 && night.dark < 0.25);
        }
    }
}
