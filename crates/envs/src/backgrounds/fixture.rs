//! Small MP4 files for tests.

use std::fs::File;
use std::path::Path;

use muxide::api::{MuxerBuilder, VideoCodec};
use openh264::encoder::{Encoder, FrameType};
use openh264::formats::{RgbSliceU8, YUVBuffer};

/// A clip of plain frames whose colours tell clip and frame.
pub(crate) struct Clip {
    /// Which clip it is.
    pub(crate) number: usize,
    /// Frames.
    pub(crate) frames: usize,
}

impl Default for Clip {
    fn default() -> Self {
        Self {
            number: 0,
            frames: 3,
        }
    }
}

impl Clip {
    const WIDTH: usize = 32;
    const HEIGHT: usize = 16;

    /// The colour of frame `frame` of clip `number`, before encoding.
    pub(crate) fn colour(number: usize, frame: usize) -> [u8; 3] {
        [60 + 12 * frame as u8, 40 + 50 * number as u8, 100]
    }
}

/// Writes `clip` to `path`.
pub(crate) fn clip(path: &Path, clip: &Clip) {
    let mut encoder = Encoder::new().unwrap();
    let mut muxer = MuxerBuilder::new(File::create(path).unwrap())
        .video(
            VideoCodec::H264,
            Clip::WIDTH as u32,
            Clip::HEIGHT as u32,
            10.0,
        )
        .build()
        .unwrap();
    for frame in 0..clip.frames {
        let picture = Clip::colour(clip.number, frame).repeat(Clip::WIDTH * Clip::HEIGHT);
        let source = RgbSliceU8::new(&picture, (Clip::WIDTH, Clip::HEIGHT));
        let stream = encoder
            .encode(&YUVBuffer::from_rgb8_source(source))
            .unwrap();
        let keyframe = matches!(stream.frame_type(), FrameType::IDR | FrameType::I);
        muxer
            .write_video(frame as f64 / 10.0, &stream.to_vec(), keyframe)
            .unwrap();
    }
    muxer.finish_in_place().unwrap();
}
