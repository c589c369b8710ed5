//! MP4 videos of H.264, which every browser plays.

use std::borrow::Borrow;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use muxide::api::{Muxer, MuxerBuilder, VideoCodec};
use openh264::OpenH264API;
use openh264::encoder::{
    Encoder, EncoderConfig, FrameRate, FrameType, IntraFramePeriod, QpRange, RateControlMode,
    UsageType, VuiConfig,
};
use openh264::formats::{RgbSliceU8, YUVBuffer};

use crate::{Error, Result, Rgb};

/// The encoder refuses less.
const MIN_SIDE: usize = 16;
/// Keyframes let a viewer jump; at this distance they cost little.
const KEYFRAME_SECS: f64 = 5.0;
/// 0 is best, 51 worst. Panels hold small text and single-pixel edges, which show artefacts early.
const QUANTIZATION: (u8, u8) = (12, 22);

/// H.264 in an MP4 container, into anything that can be written to.
struct Mp4<W: Write> {
    /// Names the video in errors.
    path: PathBuf,
    width: usize,
    height: usize,
    fps: f64,
    frames: u64,
    encoder: Encoder,
    muxer: Muxer<W>,
}

impl<W: Write> Mp4<W> {
    fn new(writer: W, path: &Path, width: usize, height: usize, fps: f64) -> Result<Self> {
        let (padded_width, padded_height) = (padded(width), padded(height));
        let muxer = MuxerBuilder::new(writer)
            .video(
                VideoCodec::H264,
                padded_width as u32,
                padded_height as u32,
                fps,
            )
            .build()
            .map_err(|error| Error::video(path, &error))?;
        let config = EncoderConfig::new()
            .usage_type(UsageType::ScreenContentRealTime)
            // Of the modes that never skip a frame the one that lets the quantizer be bounded.
            .rate_control_mode(RateControlMode::Bufferbased)
            .adaptive_quantization(false)
            .background_detection(false)
            .qp(QpRange::new(QUANTIZATION.0, QUANTIZATION.1))
            .max_frame_rate(FrameRate::from_hz(fps as f32))
            .skip_frames(false)
            .intra_frame_period(IntraFramePeriod::from_num_frames(
                (fps * KEYFRAME_SECS).ceil() as u32,
            ))
            // One thread: videos are made beside training, which needs the cores.
            .num_threads(1)
            .vui(VuiConfig::bt601());
        let encoder = Encoder::with_api_config(OpenH264API::from_source(), config)
            .map_err(|error| Error::video(path, &error))?;
        Ok(Self {
            path: path.to_owned(),
            width,
            height,
            fps,
            frames: 0,
            encoder,
            muxer,
        })
    }

    fn push(&mut self, frame: &Rgb) -> Result<()> {
        if (frame.width, frame.height) != (self.width, self.height) {
            let reason = format!(
                "frame {} is {}x{} in a video of {}x{}",
                self.frames, frame.width, frame.height, self.width, self.height
            );
            return Err(Error::video(&self.path, &reason));
        }
        let mut canvas = Rgb::filled(padded(self.width), padded(self.height), [0; 3]);
        canvas.paste(frame, 0, 0);
        let source = RgbSliceU8::new(&canvas.data, (canvas.width, canvas.height));
        let stream = self
            .encoder
            .encode(&YUVBuffer::from_rgb8_source(source))
            .map_err(|error| Error::video(&self.path, &error))?;
        let keyframe = matches!(stream.frame_type(), FrameType::IDR | FrameType::I);
        self.muxer
            .write_video(self.frames as f64 / self.fps, &stream.to_vec(), keyframe)
            .map_err(|error| Error::video(&self.path, &error))?;
        self.frames += 1;
        Ok(())
    }

    fn finish(mut self) -> Result<W> {
        if self.frames == 0 {
            return Err(Error::video(&self.path, &"it has no frames"));
        }
        self.muxer
            .finish_in_place()
            .map_err(|error| Error::video(&self.path, &error))?;
        Ok(self.muxer.into_writer())
    }
}

/// Encodes frames as they come. The file has its name only after [`finish`](Self::finish): nobody opens
/// half a video, and one that is dropped early leaves only its `.tmp`.
pub struct VideoWriter {
    path: PathBuf,
    part: PathBuf,
    mp4: Mp4<BufWriter<File>>,
}

impl std::fmt::Debug for VideoWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VideoWriter")
            .field("path", &self.path)
            .field("frames", &self.mp4.frames)
            .finish_non_exhaustive()
    }
}

impl VideoWriter {
    /// Starts a video of `width` x `height` pixels at `fps` frames per second. H.264 needs even sides of
    /// at least 16 pixels: smaller and odd ones are padded with black at the right and the bottom.
    ///
    /// # Errors
    /// [`Error::Video`] on sizes or rates that cannot be encoded, [`Error::Io`].
    pub fn create(path: &Path, width: usize, height: usize, fps: f64) -> Result<Self> {
        check_rate(path, fps)?;
        let mut part = path.as_os_str().to_owned();
        part.push(".tmp");
        let part = PathBuf::from(part);
        let file = File::create(&part).map_err(Error::io("create", &part))?;
        let mp4 = Mp4::new(BufWriter::new(file), path, width, height, fps)?;
        Ok(Self {
            path: path.to_owned(),
            part,
            mp4,
        })
    }

    /// Appends a frame.
    ///
    /// # Errors
    /// [`Error::Video`] on a frame of another size than the video's, and when the encoder fails.
    pub fn push(&mut self, frame: &Rgb) -> Result<()> {
        self.mp4.push(frame)
    }

    /// Completes the file and gives it its name.
    ///
    /// # Errors
    /// [`Error::Video`] if there is no frame, [`Error::Io`].
    pub fn finish(self) -> Result<()> {
        self.mp4
            .finish()?
            .into_inner()
            .map_err(|error| Error::io("write", &self.part)(error.into_error()))?;
        fs::rename(&self.part, &self.path).map_err(Error::io("rename to", &self.path))
    }
}

/// Writes `frames`, all of one size, as a video; they may come from a slice or one by one.
///
/// # Errors
/// As [`VideoWriter`]'s.
pub fn write_mp4(
    path: &Path,
    frames: impl IntoIterator<Item: Borrow<Rgb>>,
    fps: f64,
) -> Result<()> {
    let mut frames = frames.into_iter().peekable();
    let Some(first) = frames.peek() else {
        return Err(Error::video(path, &"it has no frames"));
    };
    let first: &Rgb = first.borrow();
    let mut video = VideoWriter::create(path, first.width, first.height, fps)?;
    for frame in frames {
        video.push(frame.borrow())?;
    }
    video.finish()
}

/// The bytes that [`write_mp4`] would write.
///
/// # Errors
/// [`Error::Video`] where there are no frames, or they cannot be encoded.
pub fn encode_mp4(frames: &[Rgb], fps: f64) -> Result<Vec<u8>> {
    let path = Path::new("in memory");
    check_rate(path, fps)?;
    let Some(first) = frames.first() else {
        return Err(Error::video(path, &"it has no frames"));
    };
    let mut mp4 = Mp4::new(Vec::new(), path, first.width, first.height, fps)?;
    for frame in frames {
        mp4.push(frame)?;
    }
    mp4.finish()
}

pub(crate) fn check_rate(path: &Path, fps: f64) -> Result<()> {
    if fps.is_finite() && fps > 0.0 {
        return Ok(());
    }
    Err(Error::video(
        path,
        &format!("{fps} frames per second are not possible"),
    ))
}

fn padded(side: usize) -> usize {
    side.max(MIN_SIDE).next_multiple_of(2)
}

#[cfg(test)]
mod tests {
    use openh264::decoder::Decoder;
    use openh264::formats::YUVSource;

    use super::*;

    /// A dark road with a light car that moves, and a label.
    fn frame(index: usize, width: usize, height: usize) -> Rgb {
        let mut frame = Rgb::filled(width, height, [60, 62, 70]);
        frame.paste(&Rgb::filled(12, 10, [200, 40, 30]), 2 * index, height / 2);
        frame.text("step 7", 2, 2, [230; 3]);
        frame
    }

    #[test]
    fn a_video_decodes_to_the_frames_it_was_made_of() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.mp4");
        let (width, height) = (101, 67);
        let frames: Vec<_> = (0..40).map(|index| frame(index, width, height)).collect();
        write_mp4(&path, &frames, 10.0).unwrap();

        let written = fs::read(&path).unwrap();
        assert_eq!(encode_mp4(&frames, 10.0).unwrap(), written);
        let decoded = decode(&written);
        assert_eq!(decoded.len(), frames.len());
        for (index, (expected, actual)) in frames.iter().zip(&decoded).enumerate() {
            assert_eq!((actual.width, actual.height), (102, 68));
            let psnr = psnr(expected, actual);
            assert!(psnr > 30.0, "frame {index}: {psnr:.1} dB");
        }
        assert_eq!(
            fs::read_dir(dir.path()).unwrap().count(),
            1,
            "temporary files are left"
        );
    }

    #[test]
    fn tiny_frames_are_padded() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.mp4");
        write_mp4(&path, [Rgb::filled(3, 5, [255; 3])], 1.5).unwrap();
        assert_eq!(decode(&fs::read(&path).unwrap())[0].width, MIN_SIDE);
    }

    #[test]
    fn impossible_videos_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.mp4");
        let none: [Rgb; 0] = [];
        assert!(write_mp4(&path, none, 10.0).is_err());
        assert!(write_mp4(&path, [frame(0, 32, 32)], f64::NAN).is_err());
        let error = write_mp4(&path, [frame(0, 32, 32), frame(1, 34, 32)], 10.0).unwrap_err();
        assert!(error.to_string().contains("frame 1 is 34x32"), "{error}");
        assert!(!path.exists());
    }

    /// Over the part of `actual` that `expected` covers.
    fn psnr(expected: &Rgb, actual: &Rgb) -> f64 {
        let mut cut = Rgb::filled(expected.width, expected.height, [0; 3]);
        cut.paste(actual, 0, 0);
        let square = |(a, b): (&u8, &u8)| (f64::from(*a) - f64::from(*b)).powi(2);
        let sum: f64 = expected.data.iter().zip(&cut.data).map(square).sum();
        10.0 * (255.0_f64.powi(2) * expected.data.len() as f64 / sum).log10()
    }

    /// Reads the file as a player does: parameter sets from `avcC`, samples from `mdat`.
    fn decode(mp4: &[u8]) -> Vec<Rgb> {
        let config = after(mp4, b"avcC");
        let sps_bytes = be(&config[6..8]);
        let pps = &config[8 + sps_bytes + 1..];
        let mut packets = vec![annex_b(&config[8..8 + sps_bytes])];
        packets.push(annex_b(&pps[2..2 + be(&pps[..2])]));
        let mdat = after(mp4, b"mdat");
        let mut samples = &mdat[..be(&mp4[mp4.len() - mdat.len() - 8..][..4]) - 8];
        while !samples.is_empty() {
            let (nal, rest) = samples[4..].split_at(be(&samples[..4]));
            packets.push(annex_b(nal));
            samples = rest;
        }
        let mut decoder = Decoder::new().unwrap();
        let mut frames = Vec::new();
        for packet in packets {
            if let Some(yuv) = decoder.decode(&packet).unwrap() {
                let (width, height) = yuv.dimensions();
                let mut frame = Rgb::filled(width, height, [0; 3]);
                yuv.write_rgb8(&mut frame.data);
                frames.push(frame);
            }
        }
        frames
    }

    fn after<'a>(bytes: &'a [u8], tag: &[u8]) -> &'a [u8] {
        let at = bytes
            .windows(tag.len())
            .position(|window| window == tag)
            .unwrap();
        &bytes[at + tag.len()..]
    }

    fn be(bytes: &[u8]) -> usize {
        bytes
            .iter()
            .fold(0, |value, byte| value << 8 | usize::from(*byte))
    }

    fn annex_b(nal: &[u8]) -> Vec<u8> {
        [&[0, 0, 0, 1], nal].concat()
    }
}
