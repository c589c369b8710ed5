//! An episode as a film: pictures, and what the decisions were made of.

use isodream_core::EnvSpec;
use isodream_envs::steps_per_s;
use isodream_proto::v1;
use isodream_telemetry::{Rgb, encode_mp4};

use crate::rollout::Moment;

/// An observation's pixel is a square of so many.
const MAGNIFY: usize = 2;

/// Takes in an episode, moment after moment.
#[derive(Debug, Default)]
pub(crate) struct Film {
    frames: Vec<Rgb>,
    window: usize,
    attention: Vec<f32>,
    gate: Vec<f32>,
}

impl Film {
    pub(crate) fn take(&mut self, moment: &Moment<'_>, spec: &EnvSpec) {
        let (width, height) = (spec.image.width, spec.image.height);
        let picture = Rgb::new(width, height, moment.step.image.clone());
        self.frames.push(picture.upscale(MAGNIFY));
        if let Some(insight) = moment.insight {
            self.window = insight.attention.len();
            self.attention.extend(&insight.attention);
            self.gate.extend(insight.gate);
        }
    }

    /// The film in the words of the protocol; none, and a warning, where it cannot be encoded.
    pub(crate) fn develop(self, spec: &EnvSpec) -> Option<v1::EpisodeFilm> {
        let fps = steps_per_s(&spec.id, spec.action_repeat);
        match encode_mp4(&self.frames, fps) {
            Ok(video) => Some(v1::EpisodeFilm {
                video: video.into(),
                fps,
                window: self.window as u32,
                attention: self.attention,
                gate: self.gate,
            }),
            Err(error) => {
                tracing::warn!(%error, "an evaluation episode cannot be shown");
                None
            }
        }
    }
}
