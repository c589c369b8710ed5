//! The videos of a folder.

use std::cmp::Ordering;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use super::Video;
use super::mp4::{self, DecodedVideo};
use crate::EnvError;

/// What to do about a folder without videos.
const CURE: &str =
    "name a folder that holds .mp4 files, or leave it out to use the embedded patterns";

/// MP4 files in the order of their numbers.
pub(crate) struct Folder {
    height: usize,
    width: usize,
    files: Vec<FileVideo>,
}

struct FileVideo {
    path: PathBuf,
    decoded: OnceLock<Result<Arc<DecodedVideo>, EnvError>>,
}

impl Folder {
    /// Lists `path` and checks every file in it, without decoding.
    pub(crate) fn open(path: &Path, height: usize, width: usize) -> Result<Self, EnvError> {
        let failed = |reason: String| EnvError::Background {
            path: path.to_owned(),
            reason,
            cure: CURE,
        };
        let unreadable = |error: std::io::Error| failed(format!("it cannot be listed: {error}"));
        let mut paths = Vec::new();
        for entry in std::fs::read_dir(path).map_err(unreadable)? {
            let file = entry.map_err(unreadable)?.path();
            let is_mp4 = file
                .extension()
                .is_some_and(|it| it.eq_ignore_ascii_case("mp4"));
            if is_mp4 && !is_hidden(&file) {
                paths.push(file);
            }
        }
        if paths.is_empty() {
            return Err(failed("it holds no .mp4 file".to_owned()));
        }
        paths.sort_by(|a, b| numeric_order(&stem(a), &stem(b)));
        for file in &paths {
            mp4::check(file)?;
        }
        let files = paths.into_iter().map(|path| FileVideo {
            path,
            decoded: OnceLock::new(),
        });
        Ok(Self {
            height,
            width,
            files: files.collect(),
        })
    }

    pub(crate) fn len(&self) -> usize {
        self.files.len()
    }

    /// Video `index`, decoded by whoever asks first.
    pub(crate) fn video(&self, index: usize) -> Result<Arc<dyn Video>, EnvError> {
        let file = &self.files[index];
        let decode = || mp4::decode(&file.path, self.height, self.width).map(Arc::new);
        match file.decoded.get_or_init(decode) {
            Ok(video) => Ok(video.clone()),
            Err(error) => Err(error.clone()),
        }
    }
}

fn stem(path: &Path) -> String {
    let stem = path.file_stem().unwrap_or_default();
    stem.to_string_lossy().into_owned()
}

/// Some systems put files like `._video0.mp4` beside those that were copied.
fn is_hidden(path: &Path) -> bool {
    stem(path).starts_with('.')
}

/// By letter, but runs of digits by their value: `video2` comes before `video10`, as the benchmark numbers
/// them.
fn numeric_order(a: &str, b: &str) -> Ordering {
    let (mut rest_a, mut rest_b) = (a, b);
    while let (Some(first_a), Some(first_b)) = (rest_a.chars().next(), rest_b.chars().next()) {
        let (part_a, part_b);
        (part_a, rest_a) = split_part(rest_a);
        (part_b, rest_b) = split_part(rest_b);
        let order = if first_a.is_ascii_digit() && first_b.is_ascii_digit() {
            let [digits_a, digits_b] = [part_a, part_b].map(|part| part.trim_start_matches('0'));
            digits_a
                .len()
                .cmp(&digits_b.len())
                .then(digits_a.cmp(digits_b))
        } else {
            part_a.cmp(part_b)
        };
        if order.is_ne() {
            return order;
        }
    }
    rest_a.len().cmp(&rest_b.len()).then(a.cmp(b))
}

/// The leading run of digits, or of everything else, and what follows it.
fn split_part(text: &str) -> (&str, &str) {
    let is_digit = text.starts_with(|first: char| first.is_ascii_digit());
    let end = text
        .find(|next: char| next.is_ascii_digit() != is_digit)
        .unwrap_or(text.len());
    text.split_at(end)
}

#[cfg(test)]
mod tests {
    use super::super::fixture::{Clip, clip};
    use super::*;

    #[test]
    fn names_sort_by_their_numbers() {
        let mut names = vec![
            "video10",
            "b",
            "video2",
            "video01",
            "video1",
            "a9",
            "a",
            "video",
            "video2b",
            "99999999999999999999999",
            "3",
        ];
        names.sort_by(|a, b| numeric_order(a, b));
        assert_eq!(
            names,
            [
                "3",
                "99999999999999999999999",
                "a",
                "a9",
                "b",
                "video",
                "video01",
                "video1",
                "video2",
                "video2b",
                "video10",
            ]
        );
    }

    #[test]
    fn a_folder_gives_its_files_in_order() {
        let dir = tempfile::tempdir().unwrap();
        for (name, number) in [("video10.mp4", 2), ("video9.MP4", 1), ("video0.mp4", 0)] {
            clip(
                &dir.path().join(name),
                &Clip {
                    number,
                    ..Clip::default()
                },
            );
        }
        std::fs::write(dir.path().join("readme.txt"), "not a video").unwrap();
        std::fs::write(dir.path().join("._video0.mp4"), "left by a copy").unwrap();
        let folder = Folder::open(dir.path(), 2, 2).unwrap();
        assert_eq!(folder.len(), 3);
        for number in 0..3 {
            let video = folder.video(number).unwrap();
            assert_eq!(video.frames(), 3);
            let mut frame = [0; 12];
            video.write(0, &mut frame);
            let green = Clip::colour(number, 0)[1];
            assert!(frame[1].abs_diff(green) <= 6, "{number}: {frame:?}");
        }
    }

    #[test]
    fn folders_without_videos_are_named_with_a_cure() {
        let dir = tempfile::tempdir().unwrap();
        for path in [dir.path().join("missing"), dir.path().to_owned()] {
            let error = Folder::open(&path, 8, 8).err().unwrap().to_string();
            assert!(error.contains(&path.display().to_string()), "{error}");
            assert!(error.contains("embedded patterns"), "{error}");
        }
        std::fs::write(dir.path().join("video3.mp4"), "broken").unwrap();
        let error = Folder::open(dir.path(), 8, 8).err().unwrap().to_string();
        assert!(error.contains("video3.mp4"), "{error}");
    }
}
