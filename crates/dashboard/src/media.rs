//! The pictures and videos of a run.

use std::path::Path;

use serde::Serialize;

/// What a run shows of itself: environment frames at which there is something whole, the newest last.
#[derive(Debug, Default, PartialEq, Eq, Serialize)]
pub struct Media {
    /// Evaluation episodes: `episode-FRAMES.mp4` and `.json`.
    pub episode: Vec<u64>,
    /// Open-loop panels: `open_loop-FRAMES.png`, `.mp4` and `.json`.
    pub open_loop: Vec<u64>,
    /// Probes of the world model: `probe-FRAMES.json`.
    pub probe: Vec<u64>,
}

impl Media {
    /// What lies in `media/` of a run; nothing where there is no such folder.
    pub(crate) fn of(run: &Path) -> Self {
        let mut media = Self::default();
        let entries = std::fs::read_dir(run.join("media"));
        for entry in entries.into_iter().flatten().flatten() {
            // The description comes last: where it is, the rest is whole.
            match parse(&entry.file_name().to_string_lossy()) {
                Some(("episode", frames, "json")) => media.episode.push(frames),
                Some(("open_loop", frames, "json")) => media.open_loop.push(frames),
                Some(("probe", frames, "json")) => media.probe.push(frames),
                _ => {}
            }
        }
        media.episode.sort_unstable();
        media.open_loop.sort_unstable();
        media.probe.sort_unstable();
        media
    }
}

/// Whether a file of this name may be handed out.
pub(crate) fn is_media(name: &str) -> bool {
    parse(name).is_some()
}

/// Kind, frames and extension of a name that the learner gives.
fn parse(name: &str) -> Option<(&str, u64, &str)> {
    let (kind, rest) = name.split_once('-')?;
    let (frames, extension) = rest.split_once('.')?;
    let known = matches!(
        (kind, extension),
        ("episode" | "open_loop", "mp4" | "json") | ("open_loop", "png") | ("probe", "json")
    );
    let is_number = frames.len() >= 10 && frames.bytes().all(|byte| byte.is_ascii_digit());
    (known && is_number).then_some((kind, frames.parse().ok()?, extension))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn only_what_the_learner_names_is_media() {
        for name in [
            "episode-0000004000.mp4",
            "open_loop-0000004000.png",
            "probe-0000004000.json",
        ] {
            assert!(is_media(name), "{name}");
        }
        for name in [
            "episode-0000004000.png",
            "probe-0000004000.mp4",
            "episode-0000004000.mp4.tmp",
            "../config.toml",
            "episode-../../x.json",
            "episode-+000004000.json",
            "other-0000004000.mp4",
            "",
        ] {
            assert!(!is_media(name), "{name}");
        }
    }

    #[test]
    fn what_is_not_described_yet_is_left_out() {
        let run = tempfile::tempdir().unwrap();
        assert_eq!(Media::of(run.path()), Media::default());
        let folder = run.path().join("media");
        std::fs::create_dir(&folder).unwrap();
        for name in [
            "episode-0000000020.json",
            "episode-0000000020.mp4",
            "episode-0000000030.mp4",
            "episode-0000000005.json",
            "open_loop-0000000007.json",
            "probe-0000000020.json",
        ] {
            std::fs::write(folder.join(name), b"x").unwrap();
        }
        let wanted = Media {
            episode: vec![5, 20],
            open_loop: vec![7],
            probe: vec![20],
        };
        assert_eq!(Media::of(run.path()), wanted);
    }
}
