//! The embedded videos: moving gradients, waves, particles and drifting textures.

use std::sync::Arc;

use isodream_core::derive_seed;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::Video;
use super::pattern::{Pattern, Style};

/// Frames after which a video is where it began, without a jump.
const FRAMES: usize = 500;

/// The two sets of the benchmark, as patterns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum VideoSet {
    /// Ten slow videos of soft contrast.
    Easy,
    /// A hundred that move faster, in colours of full contrast.
    Hard,
}

impl VideoSet {
    /// How many videos.
    pub fn videos(self) -> usize {
        match self {
            Self::Easy => 10,
            Self::Hard => 100,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Easy => "easy",
            Self::Hard => "hard",
        }
    }

    fn style(self) -> Style {
        match self {
            Self::Easy => Style {
                contrast: 0.55,
                cycles: 3,
                details: 2,
            },
            Self::Hard => Style {
                contrast: 1.0,
                cycles: 9,
                details: 5,
            },
        }
    }
}

/// A set at one size: every frame is a function of set, video and frame number, made when it is shown.
pub(crate) struct Procedural {
    set: VideoSet,
    height: usize,
    width: usize,
}

impl Procedural {
    pub(crate) fn new(set: VideoSet, height: usize, width: usize) -> Self {
        Self { set, height, width }
    }

    pub(crate) fn len(&self) -> usize {
        self.set.videos()
    }

    pub(crate) fn video(&self, index: usize) -> Arc<dyn Video> {
        let seed = derive_seed(0, &["background", self.set.name(), &index.to_string()]);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Arc::new(Movie {
            height: self.height,
            width: self.width,
            pattern: Pattern::new(index, self.set.style(), &mut rng),
        })
    }
}

struct Movie {
    height: usize,
    width: usize,
    pattern: Pattern,
}

impl Video for Movie {
    fn frames(&self) -> usize {
        FRAMES
    }

    fn write(&self, frame: usize, into: &mut [u8]) {
        let phase = frame as f32 / FRAMES as f32;
        self.pattern.paint(phase, self.height, self.width, into);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: usize = 32;

    fn frame(set: VideoSet, video: usize, index: usize) -> Vec<u8> {
        let mut frame = vec![0; SIZE * SIZE * 3];
        let videos = Procedural::new(set, SIZE, SIZE);
        videos.video(video).write(index, &mut frame);
        frame
    }

    fn difference(a: &[u8], b: &[u8]) -> f64 {
        let sum: u64 = a
            .iter()
            .zip(b)
            .map(|(a, b)| u64::from(a.abs_diff(*b)))
            .sum();
        sum as f64 / a.len() as f64
    }

    #[test]
    fn every_video_moves_and_returns_without_a_jump() {
        for set in [VideoSet::Easy, VideoSet::Hard] {
            for video in 0..set.videos() {
                let at = |index| frame(set, video, index);
                let moved = difference(&at(0), &at(FRAMES * 2 / 7));
                assert!(moved > 3.0, "{set:?} {video} moves by {moved:.2}");
                let step = difference(&at(100), &at(101));
                let wrap = difference(&at(FRAMES - 1), &at(0));
                assert!(
                    wrap <= 3.0 * step + 1.0,
                    "{set:?} {video}: {wrap:.2} after {step:.2}"
                );
            }
        }
    }

    #[test]
    fn videos_differ_from_each_other_and_the_sets_in_strength() {
        let mean = |set: VideoSet| {
            let frames: Vec<_> = (0..10).map(|video| frame(set, video, 50)).collect();
            for (index, a) in frames.iter().enumerate() {
                for b in &frames[index + 1..] {
                    assert!(difference(a, b) > 5.0, "{set:?}");
                }
            }
            let speed: f64 = (0..10)
                .map(|video| difference(&frame(set, video, 50), &frame(set, video, 51)))
                .sum();
            speed / 10.0
        };
        let (easy, hard) = (mean(VideoSet::Easy), mean(VideoSet::Hard));
        assert!(hard > 2.0 * easy, "easy {easy:.2}, hard {hard:.2}");
    }

    /// Holds the pictures fixed: recorded runs depend on them.
    #[test]
    fn pictures_do_not_change() {
        let checksum = |set: VideoSet| {
            let mut sum = 0_u64;
            for video in 0..set.videos() {
                for byte in frame(set, video, 123) {
                    sum = sum.wrapping_mul(31).wrapping_add(u64::from(byte));
                }
            }
            sum
        };
        assert_eq!(checksum(VideoSet::Easy), 5_049_345_659_573_019_979);
        assert_eq!(checksum(VideoSet::Hard), 8_841_317_373_521_762_561);
    }
}
