//! One environment's place in the videos.

use std::sync::Arc;

use isodream_core::derive_seed;

use super::{Backgrounds, Video, compose};
use crate::EnvError;

/// Which video an episode shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VideoOrder {
    /// One after the other, as the benchmark does: after `n` starts the first episode shows video
    /// `n + 1`, from the first one again after the last. What an episode shows depends on how many there
    /// were before it; environments that run side by side get different numbers to show different videos.
    Sequential(usize),
    /// Drawn from the episode's seed alone, so that the same seed shows the same pictures anywhere.
    Seeded,
}

/// Walks through [`Backgrounds`]: a video per episode, a frame per agent step.
pub struct BackgroundPlayer {
    backgrounds: Arc<Backgrounds>,
    order: VideoOrder,
    video: Option<Arc<dyn Video>>,
    step: usize,
    frame: Vec<u8>,
}

impl BackgroundPlayer {
    /// A player that has not begun an episode.
    pub fn new(backgrounds: Arc<Backgrounds>, order: VideoOrder) -> Self {
        Self {
            frame: vec![0; backgrounds.frame_bytes()],
            backgrounds,
            order,
            video: None,
            step: 0,
        }
    }

    /// Begins an episode: the next video, at frame 0.
    ///
    /// # Errors
    /// If the video cannot be decoded.
    pub fn reset(&mut self, seed: u64) -> Result<(), EnvError> {
        let index = match &mut self.order {
            VideoOrder::Sequential(index) => {
                *index = (*index + 1) % self.backgrounds.len();
                *index
            }
            VideoOrder::Seeded => {
                let draw = derive_seed(seed, &["background"]);
                (draw % self.backgrounds.len() as u64) as usize
            }
        };
        self.video = Some(self.backgrounds.video(index)?);
        self.step = 0;
        Ok(())
    }

    /// Goes on to the next agent step; a video that ends begins again.
    pub fn advance(&mut self) {
        self.step += 1;
    }

    /// Lays `image` `[H, W, 3]` over the current frame: [`compose`]. Returns which pixels were replaced,
    /// `[H, W]`.
    ///
    /// # Errors
    /// [`EnvError::NotReset`] before the first episode.
    ///
    /// # Panics
    /// If `image` has another size than the backgrounds.
    pub fn compose(&mut self, image: &mut [u8]) -> Result<Vec<bool>, EnvError> {
        let video = self.video.as_ref().ok_or(EnvError::NotReset)?;
        video.write(self.step % video.frames(), &mut self.frame);
        Ok(compose(image, &self.frame))
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixture::{Clip, clip};
    use super::super::{BackgroundSource, VideoSet};
    use super::*;

    /// Clip and frame that a player shows, read off the colour.
    fn shown(player: &mut BackgroundPlayer) -> (usize, usize) {
        let mut image = [0, 255, 0];
        assert_eq!(player.compose(&mut image).unwrap(), [true]);
        let nearest = (0..9).min_by_key(|index| {
            let colour = Clip::colour(index / 3, index % 3);
            colour
                .iter()
                .zip(image)
                .map(|(a, b)| u32::from(a.abs_diff(b)))
                .sum::<u32>()
        });
        nearest.map(|index| (index / 3, index % 3)).unwrap()
    }

    fn three_clips() -> (tempfile::TempDir, Arc<Backgrounds>) {
        let dir = tempfile::tempdir().unwrap();
        for number in 0..3 {
            let path = dir.path().join(format!("video{number}.mp4"));
            clip(
                &path,
                &Clip {
                    number,
                    ..Clip::default()
                },
            );
        }
        let source = BackgroundSource::Folder(dir.path().to_owned());
        let backgrounds = Backgrounds::open(&source, 1, 1).unwrap();
        (dir, Arc::new(backgrounds))
    }

    #[test]
    fn videos_and_frames_follow_the_benchmark() {
        let (_dir, backgrounds) = three_clips();
        let mut player = BackgroundPlayer::new(backgrounds.clone(), VideoOrder::Sequential(0));
        assert_eq!(player.compose(&mut [0, 255, 0]), Err(EnvError::NotReset));
        for video in [1, 2, 0, 1] {
            player.reset(7).unwrap();
            for frame in [0, 1, 2, 0, 1] {
                assert_eq!(shown(&mut player), (video, frame));
                player.advance();
            }
        }
        let mut second = BackgroundPlayer::new(backgrounds, VideoOrder::Sequential(1));
        second.reset(7).unwrap();
        assert_eq!(shown(&mut second), (2, 0));
    }

    #[test]
    fn a_seeded_order_depends_on_the_seed_alone_and_reaches_all() {
        let (_dir, backgrounds) = three_clips();
        let mut once = BackgroundPlayer::new(backgrounds.clone(), VideoOrder::Seeded);
        let mut counts = [0; 3];
        for seed in 0..60 {
            once.reset(seed).unwrap();
            let video = shown(&mut once).0;
            counts[video] += 1;
            let mut fresh = BackgroundPlayer::new(backgrounds.clone(), VideoOrder::Seeded);
            fresh.reset(seed).unwrap();
            assert_eq!(shown(&mut fresh).0, video, "seed {seed}");
        }
        assert!(counts.iter().all(|&count| count >= 8), "{counts:?}");
    }

    #[test]
    fn pixels_that_are_not_keyed_stay() {
        let source = BackgroundSource::Procedural(VideoSet::Hard);
        let backgrounds = Backgrounds::shared(&source, 1, 2).unwrap();
        let mut player = BackgroundPlayer::new(backgrounds, VideoOrder::Seeded);
        player.reset(3).unwrap();
        let mut image = [51, 204, 51, 200, 10, 10];
        assert_eq!(player.compose(&mut image).unwrap(), [true, false]);
        assert_eq!(image[3..], [200, 10, 10]);
    }
}
