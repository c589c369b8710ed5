//! What a run shows of itself, in the folder `media/` of its run directory.
//!
//! | file | what |
//! |---|---|
//! | `episode-FRAMES.mp4`, `.json` | an evaluation episode as the agent sees it, and [`EpisodeFacts`] |
//! | `open_loop-FRAMES.png`, `.mp4`, `.json` | the open-loop panel, and [`OpenLoopFacts`] |
//! | `probe-FRAMES.json` | a probe of the world model: [`ProbeFacts`] |
//!
//! At most 40 of a kind are kept, spread over the whole run.
//!
//! `FRAMES` are the environment frames of the run at that moment, ten digits, so that names sort by time. The JSON
//! comes last: where it is, the rest is whole.

use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::probe::{ProbeReport, ProbedState};
use crate::{Error, Result, Rgb, write_mp4};

/// Episodes, and panels, that a folder keeps at most: some 20 MB of each.
const KEPT: usize = 40;

/// An evaluation episode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EpisodeFacts {
    /// Environment frames of the run.
    pub frames: u64,
    /// Updates of the policy that drove.
    pub updates: u64,
    /// Sum of rewards.
    pub score: f64,
    /// Agent steps; the video has one frame more, the reset.
    pub length: u32,
    /// Why it ended.
    pub end_reason: String,
    /// Frames per second of the video.
    pub fps: f64,
    /// Steps of the rollout window.
    pub window: u32,
    /// Weights over the window at each step `[length, window]`, each row sums to 1 (Eq. 13); empty where the policy
    /// does not look ahead.
    pub attention: Vec<Vec<f32>>,
    /// Opening of the dependency gate at each step, 0 or 1 (Eq. 11); empty without a gate.
    pub gate: Vec<f32>,
}

/// An open-loop prediction of a sequence of replay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OpenLoopFacts {
    /// Environment frames of the run.
    pub frames: u64,
    /// Updates of the world model.
    pub updates: u64,
    /// Frames that were seen before the prediction begins.
    pub context: u32,
    /// Mean squared pixel error of each frame, pixels in `[0, 1]`; the first `context` are reconstructions.
    pub error: Vec<f64>,
}

/// A probe of the world model: its scores, and what they come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProbeFacts {
    /// Environment frames of the run.
    pub frames: u64,
    /// Updates of policy and world model.
    pub updates: u64,
    /// The scores.
    #[serde(flatten)]
    pub report: ProbeReport,
    /// The states.
    pub states: Vec<ProbedState>,
}

/// Writes into `media/` of a run directory.
#[derive(Debug, Clone)]
pub struct MediaFolder {
    dir: PathBuf,
}

impl MediaFolder {
    /// The folder of `run_dir`, which is made.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn create(run_dir: &Path) -> Result<Self> {
        let dir = run_dir.join("media");
        fs::create_dir_all(&dir).map_err(Error::io("create", &dir))?;
        Ok(Self { dir })
    }

    /// Writes an episode; `video` is an MP4.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn episode(&self, facts: &EpisodeFacts, video: &[u8]) -> Result<()> {
        self.put(&name("episode", facts.frames, "mp4"), video)?;
        self.describe("episode", facts.frames, facts)
    }

    /// Writes an open-loop panel: a still picture, and a video of `fps` frames per second.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Png`], [`Error::Video`].
    pub fn open_loop(
        &self,
        facts: &OpenLoopFacts,
        still: &Rgb,
        video: &[Rgb],
        fps: f64,
    ) -> Result<()> {
        let file = |extension| name("open_loop", facts.frames, extension);
        self.put(&file("png"), &still.encode_png()?)?;
        write_mp4(&self.dir.join(file("mp4")), video, fps)?;
        self.describe("open_loop", facts.frames, facts)
    }

    /// Writes a probe.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn probe(&self, facts: &ProbeFacts) -> Result<()> {
        self.describe("probe", facts.frames, facts)
    }

    fn describe(&self, kind: &str, frames: u64, facts: &impl Serialize) -> Result<()> {
        let file = name(kind, frames, "json");
        let text = serde_json::to_vec(facts)
            .map_err(|error| Error::io("encode", &self.dir.join(&file))(error.into()))?;
        self.put(&file, &text)?;
        self.thin(kind)
    }

    /// Removes what stands closest to what came before it, where there are too many; first and newest stay.
    fn thin(&self, kind: &str) -> Result<()> {
        let mut frames = self.frames_of(kind)?;
        while frames.len() > KEPT {
            let inner = 1..frames.len() - 1;
            let closest = inner.min_by_key(|&at| frames[at + 1] - frames[at - 1]);
            let Some(closest) = closest else { break };
            let gone = frames.remove(closest);
            for extension in ["json", "mp4", "png"] {
                match fs::remove_file(self.dir.join(name(kind, gone, extension))) {
                    Err(error) if error.kind() != ErrorKind::NotFound => {
                        return Err(Error::io("remove", &self.dir)(error));
                    }
                    _ => {}
                }
            }
        }
        Ok(())
    }

    /// Environment frames of all that is described, in order.
    fn frames_of(&self, kind: &str) -> Result<Vec<u64>> {
        let entries = fs::read_dir(&self.dir).map_err(Error::io("read", &self.dir))?;
        let parse = |file: String| {
            let frames = file.strip_prefix(kind)?.strip_prefix('-')?;
            frames.strip_suffix(".json")?.parse::<u64>().ok()
        };
        let names = entries
            .flatten()
            .map(|entry| entry.file_name().to_string_lossy().into_owned());
        let mut frames: Vec<u64> = names.filter_map(parse).collect();
        frames.sort_unstable();
        Ok(frames)
    }

    /// In one step, so that nobody reads half of it, and without a wait for the disk: training goes on meanwhile, and a
    /// picture that a crash of the machine takes is missed by nobody.
    fn put(&self, file: &str, bytes: &[u8]) -> Result<()> {
        let path = self.dir.join(file);
        let part = self.dir.join(format!("{file}.tmp"));
        File::create(&part)
            .and_then(|mut file| file.write_all(bytes))
            .map_err(Error::io("write", &part))?;
        fs::rename(&part, &path).map_err(Error::io("rename to", &path))
    }
}

fn name(kind: &str, frames: u64, extension: &str) -> String {
    format!("{kind}-{frames:010}.{extension}")
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn what_is_shown_lies_whole_under_sorted_names() {
        let run = tempfile::tempdir().unwrap();
        let media = MediaFolder::create(run.path()).unwrap();
        let episode = EpisodeFacts {
            frames: 4_000,
            updates: 90,
            score: 1.5,
            length: 2,
            end_reason: "crash".into(),
            fps: 10.0,
            window: 2,
            attention: vec![vec![0.25, 0.75], vec![0.5, 0.5]],
            gate: vec![0.0, 1.0],
        };
        media.episode(&episode, b"video").unwrap();
        let panel = OpenLoopFacts {
            frames: 120_000,
            updates: 700,
            context: 1,
            error: vec![0.1, 0.2],
        };
        let frames = [Rgb::filled(32, 16, [9; 3]), Rgb::filled(32, 16, [90; 3])];
        media.open_loop(&panel, &frames[0], &frames, 5.0).unwrap();

        let mut names: Vec<_> = fs::read_dir(run.path().join("media"))
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        assert_eq!(
            names,
            [
                "episode-0000004000.json",
                "episode-0000004000.mp4",
                "open_loop-0000120000.json",
                "open_loop-0000120000.mp4",
                "open_loop-0000120000.png",
            ]
        );
        let read = |name: &str| fs::read(run.path().join("media").join(name)).unwrap();
        let found: EpisodeFacts = serde_json::from_slice(&read(&names[0])).unwrap();
        assert_eq!(found, episode);
        let found: OpenLoopFacts = serde_json::from_slice(&read(&names[2])).unwrap();
        assert_eq!(found, panel);
    }

    #[test]
    fn what_is_too_much_goes_where_it_stands_closest() {
        let run = tempfile::tempdir().unwrap();
        let media = MediaFolder::create(run.path()).unwrap();
        for frames in (1..=200).map(|n| n * 100) {
            let facts = OpenLoopFacts {
                frames,
                updates: 1,
                context: 1,
                error: Vec::new(),
            };
            media.describe("open_loop", frames, &facts).unwrap();
        }
        let kept = media.frames_of("open_loop").unwrap();
        assert_eq!(kept.len(), KEPT);
        assert_eq!((kept[0], kept[KEPT - 1]), (100, 20_000));
        let widest = kept.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap();
        assert!(widest <= 2_000, "{kept:?}");
    }
}
