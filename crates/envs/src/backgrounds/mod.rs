//! Video backgrounds of the DMC-GB benchmark: which picture lies behind a rendered one, and where.
//!
//! [`Backgrounds`] is an ordered set of videos that environments share, [`BackgroundPlayer`] one
//! environment's place in it, [`compose`] the chroma key that lays a rendered picture over its frame.

mod chroma_key;
mod container;
#[cfg(test)]
mod fixture;
mod folder;
mod mp4;
mod pattern;
mod player;
mod procedural;
mod wave;

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, LazyLock, Mutex, PoisonError, Weak};

pub use self::chroma_key::{compose, is_background};
use self::folder::Folder;
pub use self::player::{BackgroundPlayer, VideoOrder};
use self::procedural::Procedural;
pub use self::procedural::VideoSet;
use crate::EnvError;

/// Where videos come from.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum BackgroundSource {
    /// The embedded patterns, which need no files.
    Procedural(VideoSet),
    /// The MP4 files of a folder.
    Folder(PathBuf),
}

/// Frames of one size, shown over and over.
pub(crate) trait Video: Send + Sync {
    /// How many; at least one.
    fn frames(&self) -> usize;

    /// Writes frame `frame` (below [`frames`](Self::frames)), `[H, W, 3]`.
    fn write(&self, frame: usize, into: &mut [u8]);
}

/// An ordered set of videos, all of one size.
///
/// Patterns take no memory. Files are decoded when they are first shown, in less than a second each, and kept:
/// 12 KB per frame of 64 x 64, which is 6 to 9 MB per clip of the benchmark.
pub struct Backgrounds {
    height: usize,
    width: usize,
    videos: Videos,
}

enum Videos {
    Procedural(Procedural),
    Folder(Folder),
}

type Shared = Mutex<HashMap<(BackgroundSource, usize, usize), Weak<Backgrounds>>>;

impl Backgrounds {
    /// Opens the videos of `source` at `height` x `width` pixels. Files are checked here and decoded
    /// later.
    ///
    /// # Errors
    /// [`EnvError::Background`] if the folder is missing or holds no MP4 file, or if one of them is
    /// damaged.
    pub fn open(source: &BackgroundSource, height: usize, width: usize) -> Result<Self, EnvError> {
        let videos = match source {
            BackgroundSource::Procedural(set) => {
                Videos::Procedural(Procedural::new(*set, height, width))
            }
            BackgroundSource::Folder(path) => Videos::Folder(Folder::open(path, height, width)?),
        };
        Ok(Self {
            height,
            width,
            videos,
        })
    }

    /// As [`open`](Self::open), but once per process for as long as anybody uses them.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn shared(
        source: &BackgroundSource,
        height: usize,
        width: usize,
    ) -> Result<Arc<Self>, EnvError> {
        static SHARED: LazyLock<Shared> = LazyLock::new(Mutex::default);
        let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (source.clone(), height, width);
        if let Some(backgrounds) = shared.get(&key).and_then(Weak::upgrade) {
            return Ok(backgrounds);
        }
        let backgrounds = Arc::new(Self::open(source, height, width)?);
        shared.retain(|_, others| others.strong_count() > 0);
        shared.insert(key, Arc::downgrade(&backgrounds));
        Ok(backgrounds)
    }

    /// How many videos.
    #[expect(clippy::len_without_is_empty, reason = "there is always one")]
    pub fn len(&self) -> usize {
        match &self.videos {
            Videos::Procedural(set) => set.len(),
            Videos::Folder(folder) => folder.len(),
        }
    }

    /// Bytes of one frame.
    pub fn frame_bytes(&self) -> usize {
        self.height * self.width * 3
    }

    /// Video `index`, counted on from 0 again after the last one.
    pub(crate) fn video(&self, index: usize) -> Result<Arc<dyn Video>, EnvError> {
        let index = index % self.len();
        match &self.videos {
            Videos::Procedural(set) => Ok(set.video(index)),
            Videos::Folder(folder) => folder.video(index),
        }
    }
}

impl std::fmt::Debug for Backgrounds {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Backgrounds")
            .field("height", &self.height)
            .field("width", &self.width)
            .field("videos", &self.len())
            .finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_sources_are_opened_once_and_closed_after_use() {
        let source = BackgroundSource::Procedural(VideoSet::Easy);
        let first = Backgrounds::shared(&source, 12, 12).unwrap();
        let second = Backgrounds::shared(&source, 12, 12).unwrap();
        let other = Backgrounds::shared(&source, 12, 14).unwrap();
        assert!(Arc::ptr_eq(&first, &second));
        assert!(!Arc::ptr_eq(&first, &other));
        let weak = Arc::downgrade(&first);
        drop((first, second));
        assert!(weak.upgrade().is_none());
    }
}
