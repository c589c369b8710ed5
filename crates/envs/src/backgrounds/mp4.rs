//! MP4 files of H.264, decoded once to the size they are shown at.

use std::fmt::Display;
use std::path::Path;

use openh264::OpenH264API;
use openh264::decoder::{DecodeOptions, DecodedYUV, Decoder, DecoderConfig, Flush};
use openh264::formats::YUVSource;

use super::Video;
use super::container::{self, Track};
use crate::EnvError;
use crate::resize::bilinear;

/// What to do about a file that cannot be decoded.
const CURE: &str = "remove it or replace it with an MP4 of H.264 video, for example by \
     `ffmpeg -i FILE -c:v libx264 -pix_fmt yuv420p -an OUT.mp4`";

/// The frames of a file: `[N, H, W, 3]` bytes.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct DecodedVideo {
    bytes_per_frame: usize,
    frames: Vec<u8>,
}

impl Video for DecodedVideo {
    fn frames(&self) -> usize {
        self.frames.len() / self.bytes_per_frame
    }

    fn write(&self, frame: usize, into: &mut [u8]) {
        let start = frame * self.bytes_per_frame;
        into.copy_from_slice(&self.frames[start..start + self.bytes_per_frame]);
    }
}

/// Checks all that can be checked without decoding: container, codec, and that no sample is cut off.
///
/// # Errors
/// [`EnvError::Background`].
pub(crate) fn check(path: &Path) -> Result<(), EnvError> {
    open(path).map(drop)
}

/// Decodes all frames, in the order they are shown in, to `[height, width, 3]` each: bilinear without
/// antialiasing, truncated, as the benchmark does.
///
/// # Errors
/// [`EnvError::Background`] on a file that cannot be read or decoded.
pub(crate) fn decode(path: &Path, height: usize, width: usize) -> Result<DecodedVideo, EnvError> {
    let (bytes, track) = open(path)?;
    let failed = |error: openh264::Error| broken(path, format!("decoding fails: {error}"));
    // With a flush after each packet, a stream whose frames refer to later ones breaks within ten frames.
    let config = DecoderConfig::new().flush_after_decode(Flush::NoFlush);
    let options = DecodeOptions::new().flush_after_decode(Flush::NoFlush);
    let mut decoder =
        Decoder::with_api_config(OpenH264API::from_source(), config).map_err(failed)?;
    let mut frames = Vec::with_capacity(track.samples.len() * height * width * 3);
    let mut packet = track.parameters.clone();
    for sample in &track.samples {
        track
            .append(&bytes[sample.clone()], &mut packet)
            .map_err(|reason| broken(path, reason))?;
        let frame = decoder
            .decode_with_options(&packet, options.clone())
            .map_err(failed)?;
        frames.extend(frame.iter().flat_map(|frame| shrink(frame, height, width)));
        packet.clear();
    }
    for frame in decoder.flush_remaining().map_err(failed)? {
        frames.extend(shrink(&frame, height, width));
    }
    let video = DecodedVideo {
        bytes_per_frame: height * width * 3,
        frames,
    };
    if video.frames() != track.samples.len() {
        let reason = format!(
            "only {} of its {} frames can be decoded",
            video.frames(),
            track.samples.len()
        );
        return Err(broken(path, reason));
    }
    Ok(video)
}

fn open(path: &Path) -> Result<(Vec<u8>, Track), EnvError> {
    let bytes = std::fs::read(path).map_err(|error| EnvError::Background {
        path: path.to_owned(),
        reason: format!("it cannot be read: {error}"),
        cure: "check its permissions",
    })?;
    let track = container::read(&bytes).map_err(|reason| broken(path, reason))?;
    Ok((bytes, track))
}

fn broken(path: &Path, reason: impl Display) -> EnvError {
    EnvError::Background {
        path: path.to_owned(),
        reason: reason.to_string(),
        cure: CURE,
    }
}

/// Converts only the pixels that resampling looks at.
fn shrink(frame: &DecodedYUV<'_>, height: usize, width: usize) -> Vec<u8> {
    let (from_width, from_height) = frame.dimensions();
    let (y_stride, u_stride, v_stride) = frame.strides();
    bilinear((from_height, from_width), (height, width), |row, column| {
        rgb(
            frame.y()[row * y_stride + column],
            frame.u()[row / 2 * u_stride + column / 2],
            frame.v()[row / 2 * v_stride + column / 2],
        )
    })
}

/// ITU-R BT.601 with 16..=235 for black to white, which OpenCV (the benchmark's reader) takes for every
/// file. Like there, factors have 13 binary places and every product is rounded down by itself: rounding the
/// sum would make pictures brighter by 1 in red and blue and by 1.5 in green.
fn rgb(y: u8, u: u8, v: u8) -> [u8; 3] {
    let product = |factor: i32, level: u8, zero: i32| (factor * (i32::from(level) - zero)) >> 13;
    let luma = product(9_539, y, 16);
    [
        luma + product(13_075, v, 128),
        luma + product(-3_209, u, 128) + product(-6_660, v, 128),
        luma + product(16_525, u, 128),
    ]
    .map(|channel| channel.clamp(0, 255) as u8)
}

#[cfg(test)]
mod tests {
    use super::super::fixture::{Clip, clip};
    use super::*;

    #[test]
    fn colours_match_the_standard() {
        assert_eq!(rgb(235, 128, 128), [255; 3]);
        assert_eq!(rgb(16, 128, 128), [0; 3]);
        assert_eq!(rgb(126, 128, 128), [128; 3]);
        // Red: 65 * 1.1644 = 75.7 and 112 * 1.596 = 178.8, each rounded down. Green: 150.2, 28.9 and 76.4.
        // Blue: 29.1 and 225.9.
        assert_eq!(rgb(81, 90, 240), [253, 0, 0]);
        assert_eq!(rgb(145, 54, 34), [0, 254, 0]);
        assert_eq!(rgb(41, 240, 110), [0, 0, 254]);
    }

    #[test]
    fn frames_come_in_order_and_at_the_size_asked_for() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.mp4");
        clip(
            &path,
            &Clip {
                frames: 12,
                ..Clip::default()
            },
        );
        check(&path).unwrap();
        let video = decode(&path, 8, 10).unwrap();
        assert_eq!(video.frames(), 12);
        let mut frame = vec![0; 8 * 10 * 3];
        for index in 0..12 {
            video.write(index, &mut frame);
            let expected = Clip::colour(0, index);
            for pixel in frame.as_chunks::<3>().0 {
                for (actual, expected) in pixel.iter().zip(expected) {
                    assert!(
                        actual.abs_diff(expected) <= 6,
                        "frame {index}: {pixel:?} {expected:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn broken_files_are_named_with_a_cure() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("whole.mp4");
        clip(&path, &Clip::default());
        let whole = std::fs::read(&path).unwrap();
        let broken = dir.path().join("broken.mp4");
        let mut cases = vec![
            (b"not a video".to_vec(), "no whole MP4"),
            (Vec::new(), "no whole MP4"),
        ];
        for part in 1..20 {
            cases.push((whole[..whole.len() * part / 20].to_vec(), ""));
        }
        for (bytes, expected) in cases {
            std::fs::write(&broken, &bytes).unwrap();
            let error = check(&broken).unwrap_err().to_string();
            assert!(
                error.contains("broken.mp4") && error.contains("ffmpeg"),
                "{error}"
            );
            assert!(error.contains(expected), "{} bytes: {error}", bytes.len());
        }
        let error = decode(&dir.path().join("none.mp4"), 8, 8).unwrap_err();
        assert!(error.to_string().contains("cannot be read"), "{error}");
    }

    /// Damage anywhere gives an error or a video of the right length, never a panic.
    #[test]
    fn flipped_bytes_never_panic() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.mp4");
        clip(
            &path,
            &Clip {
                frames: 4,
                ..Clip::default()
            },
        );
        let whole = std::fs::read(&path).unwrap();
        let mut refused = 0;
        for at in (0..whole.len()).step_by(whole.len() / 150 + 1) {
            let mut bytes = whole.clone();
            bytes[at] ^= 0xff;
            std::fs::write(&path, &bytes).unwrap();
            match decode(&path, 4, 4) {
                Ok(video) => assert!(video.frames() > 0),
                Err(error) => {
                    assert!(error.to_string().contains("a.mp4"), "{error}");
                    refused += 1;
                }
            }
        }
        assert!(refused > 10, "{refused}");
    }
}
