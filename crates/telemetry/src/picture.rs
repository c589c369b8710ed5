//! Pictures for people: panels of observations, reconstructions and masks.

use std::fs;
use std::path::Path;

use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};

use crate::{Error, Result, font};

/// What shows between tiles and behind labels.
const BACKGROUND: [u8; 3] = [24, 24, 27];
const LABEL_COLOR: [u8; 3] = [235, 235, 235];
const LABEL_MARGIN: usize = 2;

/// Stops of the heat scale, evenly spaced from 0 to 1: dark to light, so that it also reads in gray.
const HEAT: [[u8; 3]; 6] = [
    [0, 0, 8],
    [66, 10, 104],
    [147, 38, 103],
    [221, 81, 58],
    [252, 165, 10],
    [252, 255, 164],
];

/// A picture of 8-bit red, green and blue.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rgb {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `[height, width, 3]`, row-major.
    pub data: Vec<u8>,
}

impl Rgb {
    /// A picture of `[height, width, 3]` bytes, as environments make them.
    ///
    /// # Panics
    /// If `data` has another length: a defect of the caller.
    pub fn new(width: usize, height: usize, data: Vec<u8>) -> Self {
        assert_eq!(
            data.len(),
            width * height * 3,
            "bytes of a {width}x{height} picture"
        );
        Self {
            width,
            height,
            data,
        }
    }

    /// A picture of one colour.
    pub fn filled(width: usize, height: usize, color: [u8; 3]) -> Self {
        Self::new(width, height, color.repeat(width * height))
    }

    /// A gray picture of `[height, width]` values; 0 is black, 1 is white, others are clamped.
    ///
    /// # Panics
    /// If `values` has another length: a defect of the caller.
    pub fn gray(width: usize, height: usize, values: &[f32]) -> Self {
        Self::mapped(width, height, values, |value| {
            [(value * 255.0).round() as u8; 3]
        })
    }

    /// A picture of `[height, width]` values on a scale from black (0) over red to light yellow (1);
    /// others are clamped.
    ///
    /// # Panics
    /// If `values` has another length: a defect of the caller.
    pub fn heat(width: usize, height: usize, values: &[f32]) -> Self {
        Self::mapped(width, height, values, heat_color)
    }

    fn mapped(width: usize, height: usize, values: &[f32], color: impl Fn(f32) -> [u8; 3]) -> Self {
        let data = values
            .iter()
            .flat_map(|value| color(value.clamp(0.0, 1.0)))
            .collect();
        Self::new(width, height, data)
    }

    /// The picture with every pixel as a `factor` x `factor` square.
    #[must_use]
    pub fn upscale(&self, factor: usize) -> Self {
        let mut data = Vec::with_capacity(self.data.len() * factor * factor);
        for row in self.data.chunks_exact((self.width * 3).max(1)) {
            let wide: Vec<u8> = row
                .chunks_exact(3)
                .flat_map(|pixel| pixel.repeat(factor))
                .collect();
            for _ in 0..factor {
                data.extend_from_slice(&wide);
            }
        }
        Self::new(self.width * factor, self.height * factor, data)
    }

    /// Copies `other` onto this picture with its upper left corner at `(x, y)`; what does not fit is cut.
    pub fn paste(&mut self, other: &Self, x: usize, y: usize) {
        let width = other.width.min(self.width.saturating_sub(x));
        for row in 0..other.height.min(self.height.saturating_sub(y)) {
            let from = row * other.width * 3;
            let to = ((y + row) * self.width + x) * 3;
            self.data[to..to + width * 3].copy_from_slice(&other.data[from..from + width * 3]);
        }
    }

    /// Pictures side by side, rows of them below each other, `gap` pixels between; rows may differ in
    /// length and pictures in size.
    pub fn tile(rows: &[Vec<Self>], gap: usize) -> Self {
        let gaps = |count: usize| gap * count.saturating_sub(1);
        let row_width =
            |row: &Vec<Self>| row.iter().map(|tile| tile.width).sum::<usize>() + gaps(row.len());
        let row_height = |row: &Vec<Self>| row.iter().map(|tile| tile.height).max().unwrap_or(0);
        let width = rows.iter().map(row_width).max().unwrap_or(0);
        let height = rows.iter().map(row_height).sum::<usize>() + gaps(rows.len());
        let mut out = Self::filled(width, height, BACKGROUND);
        let mut y = 0;
        for row in rows {
            let mut x = 0;
            for tile in row {
                out.paste(tile, x, y);
                x += tile.width + gap;
            }
            y += row_height(row) + gap;
        }
        out
    }

    /// Writes `text` in a 5 x 7 font with its upper left corner at `(x, y)`; what does not fit is cut.
    pub fn text(&mut self, text: &str, x: usize, y: usize, color: [u8; 3]) {
        for (index, c) in text.chars().enumerate() {
            for (row, bits) in font::glyph(c).into_iter().enumerate() {
                for column in 0..font::WIDTH {
                    if bits >> (font::WIDTH - 1 - column) & 1 == 1 {
                        self.set(x + index * font::ADVANCE + column, y + row, color);
                    }
                }
            }
        }
    }

    /// The picture below a strip with `text` on it; the strip is never wider than the picture.
    #[must_use]
    pub fn labelled(&self, text: &str) -> Self {
        let strip = font::HEIGHT + 2 * LABEL_MARGIN;
        let mut out = Self::filled(self.width, self.height + strip, BACKGROUND);
        out.text(text, LABEL_MARGIN, LABEL_MARGIN, LABEL_COLOR);
        out.paste(self, 0, strip);
        out
    }

    /// The picture as PNG.
    ///
    /// # Errors
    /// [`Error::Png`], for example if the picture is empty.
    pub fn encode_png(&self) -> Result<Vec<u8>> {
        let mut png = Vec::new();
        PngEncoder::new(&mut png)
            .write_image(
                &self.data,
                self.width as u32,
                self.height as u32,
                ExtendedColorType::Rgb8,
            )
            .map_err(|error| Error::Png {
                width: self.width,
                height: self.height,
                reason: error.to_string(),
            })?;
        Ok(png)
    }

    /// Saves the picture as PNG.
    ///
    /// # Errors
    /// [`Error::Png`], [`Error::Io`].
    pub fn save_png(&self, path: &Path) -> Result<()> {
        fs::write(path, self.encode_png()?).map_err(Error::io("write", path))
    }

    fn set(&mut self, x: usize, y: usize, color: [u8; 3]) {
        if x < self.width && y < self.height {
            let at = (y * self.width + x) * 3;
            self.data[at..at + 3].copy_from_slice(&color);
        }
    }
}

fn heat_color(value: f32) -> [u8; 3] {
    let position = value * (HEAT.len() - 1) as f32;
    let index = (position as usize).min(HEAT.len() - 2);
    let part = position - index as f32;
    let [low, high] = [HEAT[index], HEAT[index + 1]];
    std::array::from_fn(|channel| {
        let (low, high) = (f32::from(low[channel]), f32::from(high[channel]));
        (low + (high - low) * part).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixel(picture: &Rgb, x: usize, y: usize) -> [u8; 3] {
        let at = (y * picture.width + x) * 3;
        picture.data[at..at + 3].try_into().unwrap()
    }

    #[test]
    fn gray_clamps() {
        let picture = Rgb::gray(2, 2, &[-1.0, 0.5, 7.0, f32::NAN]);
        let grays: Vec<u8> = picture.data.chunks(3).map(|pixel| pixel[0]).collect();
        assert_eq!(grays, [0, 128, 255, 0]);
    }

    #[test]
    fn heat_gets_lighter_from_end_to_end() {
        let values: Vec<f32> = (0..=20).map(|index| index as f32 / 20.0).collect();
        let picture = Rgb::heat(21, 1, &values);
        assert_eq!(pixel(&picture, 0, 0), HEAT[0]);
        assert_eq!(pixel(&picture, 20, 0), HEAT[5]);
        let light = |x| {
            let [r, g, b] = pixel(&picture, x, 0).map(f64::from);
            0.299 * r + 0.587 * g + 0.114 * b
        };
        for x in 1..21 {
            assert!(light(x) > light(x - 1), "at {x}");
        }
    }

    #[test]
    fn upscaling_repeats_pixels() {
        let picture = Rgb::new(2, 1, vec![1, 2, 3, 4, 5, 6]).upscale(2);
        assert_eq!((picture.width, picture.height), (4, 2));
        let row = [1, 2, 3, 1, 2, 3, 4, 5, 6, 4, 5, 6];
        assert_eq!(picture.data, row.repeat(2));
    }

    #[test]
    fn tiles_keep_their_places() {
        let tile = |width, height, value| Rgb::filled(width, height, [value; 3]);
        let rows = [
            vec![tile(2, 3, 200), tile(1, 1, 201)],
            vec![tile(5, 1, 202)],
        ];
        let picture = Rgb::tile(&rows, 1);
        assert_eq!((picture.width, picture.height), (5, 5));
        assert_eq!(pixel(&picture, 1, 2), [200; 3]);
        assert_eq!(pixel(&picture, 2, 0), BACKGROUND);
        assert_eq!(pixel(&picture, 3, 0), [201; 3]);
        assert_eq!(pixel(&picture, 3, 1), BACKGROUND);
        assert_eq!(pixel(&picture, 0, 3), BACKGROUND);
        assert_eq!(pixel(&picture, 4, 4), [202; 3]);
        assert_eq!(Rgb::tile(&[], 3), tile(0, 0, 0));
    }

    #[test]
    fn text_is_drawn_and_cut_at_the_border() {
        let mut picture = Rgb::filled(8, 7, [0; 3]);
        picture.text("Tx", 0, 0, [255; 3]);
        let row = |y| -> String {
            (0..8)
                .map(|x| {
                    if pixel(&picture, x, y) == [255; 3] {
                        '#'
                    } else {
                        '.'
                    }
                })
                .collect()
        };
        assert_eq!(row(0), "#####...");
        assert_eq!(row(6), "..#...#.");
    }

    #[test]
    fn a_label_leaves_the_picture_whole() {
        let picture = Rgb::filled(30, 4, [1, 2, 3]);
        let labelled = picture.labelled("prior");
        assert_eq!((labelled.width, labelled.height), (30, 15));
        assert!(labelled.data.ends_with(&picture.data));
        assert!(labelled.data.chunks(3).any(|pixel| pixel == LABEL_COLOR));
    }

    #[test]
    fn a_saved_picture_reads_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let picture = Rgb::heat(
            5,
            3,
            &std::array::from_fn::<f32, 15, _>(|index| index as f32 / 15.0),
        );
        picture.save_png(&path).unwrap();
        assert_eq!(
            image::open(&path).unwrap().into_rgb8().into_raw(),
            picture.data
        );
    }

    #[test]
    fn an_empty_picture_is_an_error_not_a_panic() {
        let error = Rgb::filled(0, 0, [0; 3]).encode_png().unwrap_err();
        assert!(error.to_string().contains("0x0"), "{error}");
        assert!(Rgb::filled(0, 0, [0; 3]).upscale(3).data.is_empty());
    }
}
