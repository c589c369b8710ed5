//! The chroma key of the DMC-GB benchmark: which pixels of a rendered picture show the background.

/// Least saturation times 255.
const SATURATION: i32 = 80;
/// Least value times 255.
const VALUE: i32 = 70;

/// Whether a pixel is background: hue in [100, 185] degrees, saturation at least 80/255 and value at
/// least 70/255.
///
/// The conditions are those of HSV, multiplied out: whole numbers leave no pixel to the rounding of a
/// division.
pub fn is_background([red, green, blue]: [u8; 3]) -> bool {
    let [r, g, b] = [red, green, blue].map(i32::from);
    let value = r.max(g).max(b);
    let chroma = value - r.min(g).min(b);
    if value < VALUE || 255 * chroma < SATURATION * value {
        return false;
    }
    if value == g {
        // hue = 120 + 60 (b - r) / chroma, at most 180.
        3 * (b - r) >= -chroma
    } else {
        // hue = 240 + 60 (r - g) / chroma where blue is greatest; where red is, it is near 0 or 360.
        value == b && 12 * (r - g) <= -11 * chroma
    }
}

/// Lays `image` over `background` (both `[H, W, 3]`): background pixels of `image` are replaced in place.
/// Returns which ones were, `[H, W]`.
///
/// # Panics
/// If the two differ in length.
pub fn compose(image: &mut [u8], background: &[u8]) -> Vec<bool> {
    assert_eq!(image.len(), background.len(), "image and background differ");
    let (pixels, _) = image.as_chunks_mut::<3>();
    let (behind, _) = background.as_chunks::<3>();
    pixels
        .iter_mut()
        .zip(behind)
        .map(|(pixel, behind)| {
            let keyed = is_background(*pixel);
            if keyed {
                *pixel = *behind;
            }
            keyed
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every row: a colour whose hue, saturation or value lies at a limit or just beyond it.
    const LIMITS: &[([u8; 3], bool, &str)] = &[
        ([51, 204, 51], true, "the recoloured skybox: hue 120"),
        ([100, 200, 70], true, "hue 106.2: 120 - 60*30/130"),
        ([90, 150, 60], true, "hue 100: 120 - 60*30/90"),
        ([91, 150, 60], false, "hue 99.3"),
        ([60, 150, 150], true, "hue 180"),
        ([40, 150, 160], true, "hue 185: 240 - 60*110/120"),
        ([40, 149, 160], false, "hue 185.5"),
        ([175, 255, 175], true, "saturation 80/255 exactly"),
        ([176, 255, 176], false, "saturation 79/255"),
        ([0, 70, 0], true, "value 70"),
        ([0, 69, 0], false, "value 69"),
        ([200, 30, 30], false, "red"),
        (
            [200, 200, 20],
            false,
            "yellow, where red and green are both greatest: hue 60",
        ),
        ([20, 20, 200], false, "blue: hue 240"),
        ([200, 20, 200], false, "magenta: hue 300"),
        ([128, 128, 128], false, "grey has no saturation"),
        ([0, 0, 0], false, "black"),
        ([255, 255, 255], false, "white"),
    ];

    #[test]
    fn colours_at_the_limits() {
        for &(colour, expected, why) in LIMITS {
            assert_eq!(is_background(colour), expected, "{colour:?}: {why}");
        }
    }

    /// Textbook HSV in f64, with distances to the limits that rounding cannot bridge.
    #[test]
    fn agrees_with_the_definition_wherever_rounding_cannot_decide() {
        let mut compared = 0;
        for index in 0..17_u32.pow(3) {
            let colour = [index / 289, index / 17 % 17, index % 17].map(|step| (step * 15) as u8);
            let [r, g, b] = colour.map(|channel| f64::from(channel) / 255.0);
            let value = r.max(g).max(b);
            let chroma = value - r.min(g).min(b);
            if chroma == 0.0 {
                assert!(!is_background(colour));
                continue;
            }
            let hue = if value == r {
                (60.0 * (g - b) / chroma).rem_euclid(360.0)
            } else if value == g {
                60.0 * (b - r) / chroma + 120.0
            } else {
                60.0 * (r - g) / chroma + 240.0
            };
            let saturation = chroma / value;
            let margins = [
                hue - 100.0,
                185.0 - hue,
                saturation * 255.0 - 80.0,
                value * 255.0 - 70.0,
            ];
            if margins.iter().any(|margin| margin.abs() < 1e-9) {
                continue;
            }
            let expected = margins.iter().all(|&margin| margin > 0.0);
            assert_eq!(is_background(colour), expected, "{colour:?}");
            compared += 1;
        }
        assert!(compared > 4_500, "{compared}");
    }

    #[test]
    fn only_keyed_pixels_are_replaced() {
        let mut image = [[51, 204, 51], [200, 30, 30], [0, 69, 0], [0, 70, 0]].concat();
        let background: Vec<u8> = (1..=12).collect();
        let mask = compose(&mut image, &background);
        assert_eq!(mask, [true, false, false, true]);
        assert_eq!(image, [1, 2, 3, 200, 30, 30, 0, 69, 0, 10, 11, 12]);
    }
}
