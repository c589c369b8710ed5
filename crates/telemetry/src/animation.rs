//! Animated GIFs: for pages that show pictures but no videos.

use std::borrow::Borrow;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use image::codecs::gif::{GifEncoder, Repeat};
use image::{Delay, Frame, Rgba, RgbaImage};

use crate::video::check_rate;
use crate::{Error, Result, Rgb};

/// Of 1 to 30: how carefully 256 colours are chosen for each frame; greater is faster.
const SPEED: i32 = 10;

/// An animation as bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Gif {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The file.
    pub bytes: Vec<u8>,
}

/// Writes `frames` as an animation that repeats for ever.
///
/// # Errors
/// [`Error::Video`] if there are no frames or the rate is not above 0, [`Error::Io`].
pub fn write_gif(
    path: &Path,
    frames: impl IntoIterator<Item: Borrow<Rgb>>,
    fps: f64,
) -> Result<()> {
    let mut frames = frames.into_iter().peekable();
    check(path, frames.peek().is_some(), fps)?;
    let file = File::create(path).map_err(Error::io("create", path))?;
    encode(BufWriter::new(file), path, frames, fps)
}

/// [`write_gif`] into memory.
///
/// # Errors
/// [`Error::Video`] if there are no frames or the rate is not above 0.
pub fn encode_gif(frames: &[Rgb], fps: f64) -> Result<Gif> {
    let path = Path::new("in memory");
    check(path, !frames.is_empty(), fps)?;
    let mut bytes = Vec::new();
    encode(&mut bytes, path, frames, fps)?;
    Ok(Gif {
        width: frames[0].width,
        height: frames[0].height,
        bytes,
    })
}

fn check(path: &Path, has_frames: bool, fps: f64) -> Result<()> {
    check_rate(path, fps)?;
    if has_frames {
        return Ok(());
    }
    Err(Error::video(path, &"it has no frames"))
}

fn encode(
    writer: impl Write,
    path: &Path,
    frames: impl IntoIterator<Item: Borrow<Rgb>>,
    fps: f64,
) -> Result<()> {
    let mut encoder = GifEncoder::new_with_speed(writer, SPEED);
    let failed = |error: image::ImageError| Error::video(path, &error);
    encoder.set_repeat(Repeat::Infinite).map_err(failed)?;
    // The format counts in hundredths of a second.
    let delay = Delay::from_numer_denom_ms((1e3 / fps).round().max(1.0) as u32, 1);
    for frame in frames {
        let frame: &Rgb = frame.borrow();
        let pixels = RgbaImage::from_fn(frame.width as u32, frame.height as u32, |x, y| {
            let at = (y as usize * frame.width + x as usize) * 3;
            Rgba([frame.data[at], frame.data[at + 1], frame.data[at + 2], 255])
        });
        encoder
            .encode_frame(Frame::from_parts(pixels, 0, 0, delay))
            .map_err(failed)?;
    }
    Ok(())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::io::BufReader;

    use image::AnimationDecoder;
    use image::codecs::gif::GifDecoder;

    use super::*;

    #[test]
    fn frames_come_back_in_order_and_time() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.gif");
        let colors = [[250, 10, 10], [10, 250, 10], [10, 10, 250]];
        let frames = colors.map(|color| Rgb::filled(20, 12, color));
        write_gif(&path, &frames, 5.0).unwrap();
        let gif = encode_gif(&frames, 5.0).unwrap();
        assert_eq!((gif.width, gif.height), (20, 12));
        assert_eq!(gif.bytes, std::fs::read(&path).unwrap());
        let decoder = GifDecoder::new(BufReader::new(File::open(&path).unwrap())).unwrap();
        let decoded = decoder.into_frames().collect_frames().unwrap();
        assert_eq!(decoded.len(), 3);
        for (frame, color) in decoded.iter().zip(colors) {
            assert_eq!(frame.delay().numer_denom_ms(), (200, 1));
            let Rgba([r, g, b, _]) = *frame.buffer().get_pixel(7, 7);
            for (found, wanted) in [r, g, b].into_iter().zip(color) {
                assert!(found.abs_diff(wanted) < 12, "{found} {wanted}");
            }
        }
    }

    #[test]
    fn no_frames_and_no_time_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.gif");
        let none: [Rgb; 0] = [];
        assert!(write_gif(&path, &none, 5.0).is_err());
        assert!(write_gif(&path, [Rgb::filled(4, 4, [0; 3])], 0.0).is_err());
        assert!(!path.exists());
    }
}
