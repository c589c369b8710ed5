//! What a run shows of itself: episodes that actors filmed, open-loop predictions, and probes of the world model.
//!
//! Pictures are for people: where one cannot be made, the log says so and training goes on.

use std::thread::JoinHandle;

use anyhow::{Context, ensure};
use isodream_model::Batch;
use isodream_model::open_loop::open_loop;
use isodream_model::world_model::WorldModel;
use isodream_proto::v1;
use isodream_telemetry::media::{EpisodeFacts, MediaFolder, OpenLoopFacts, ProbeFacts};
use isodream_telemetry::probe::{Probe, ProbedState};
use isodream_telemetry::{Gif, Rgb, encode_gif};
use tch::{Kind, Tensor};

use crate::panel::Panel;

/// Frames that the prediction is given, as in the paper.
const CONTEXT: i64 = 5;

/// Sequences that the error is a mean over; the first one is drawn.
const SEQUENCES: i64 = 8;

/// Where a run's pictures go. Panels are drawn and encoded in a thread, one at a time.
#[derive(Debug)]
pub(crate) struct Media {
    folder: MediaFolder,
    drawing: Option<JoinHandle<anyhow::Result<Drawn>>>,
}

/// A panel that was drawn.
#[derive(Debug)]
pub(crate) struct Drawn {
    pub(crate) facts: OpenLoopFacts,
    pub(crate) still: Rgb,
    pub(crate) moving: Gif,
}

impl Drawn {
    /// Mean squared error over all frames that were predicted.
    pub(crate) fn error(&self) -> f64 {
        let predicted = self.facts.error.get(self.facts.context as usize..);
        let predicted = predicted.unwrap_or_default();
        predicted.iter().sum::<f64>() / predicted.len() as f64
    }
}

impl Media {
    pub(crate) fn new(folder: MediaFolder) -> Self {
        Self {
            folder,
            drawing: None,
        }
    }

    /// Keeps the film of an episode, if there is one.
    pub(crate) fn episode(&self, frames: u64, report: &v1::EpisodeReport) {
        let Some(film) = &report.film else { return };
        let kept = facts(frames, report, film)
            .and_then(|facts| Ok(self.folder.episode(&facts, &film.video)?));
        if let Err(error) = kept {
            tracing::warn!(
                error = format!("{error:#}"),
                actor = report.actor_id,
                "an episode cannot be shown"
            );
        }
    }

    /// Keeps the probe that came with an evaluation, if there is one, and tells its curves.
    pub(crate) fn probe(&self, frames: u64, report: &v1::EpisodeReport) -> Vec<(String, f64)> {
        let Some(found) = &report.probe else {
            return Vec::new();
        };
        let kept = probe_facts(frames, report, found).and_then(|facts| {
            self.folder.probe(&facts)?;
            Ok(facts.report.metrics())
        });
        kept.unwrap_or_else(|error| {
            let error = format!("{error:#}");
            tracing::warn!(error, actor = report.actor_id, "a probe cannot be shown");
            Vec::new()
        })
    }

    /// Predicts some sequences of `batch` and begins to draw the first; nothing where the last panel is still in work,
    /// or sequences are too short to predict anything.
    pub(crate) fn open_loop(
        &mut self,
        frames: u64,
        updates: u64,
        world: &WorldModel,
        batch: &Batch,
    ) {
        if self.drawing.is_some() || batch.images.size()[1] <= CONTEXT {
            return;
        }
        let some = batch.first(SEQUENCES);
        let prediction = open_loop(world, &some, CONTEXT);
        let facts = OpenLoopFacts {
            frames,
            updates,
            context: CONTEXT as u32,
            error: error(&prediction.composition.image, &some.images),
        };
        let panel = Panel::new(&some, &prediction, CONTEXT);
        let folder = self.folder.clone();
        let drawing = std::thread::Builder::new()
            .name("panel".into())
            .spawn(move || {
                let still = panel.still();
                folder.open_loop(&facts, &still, &panel.video(), Panel::FPS)?;
                let moving = encode_gif(&panel.thumbnails(), Panel::FPS)?;
                Ok(Drawn {
                    facts,
                    still,
                    moving,
                })
            });
        match drawing {
            Ok(drawing) => self.drawing = Some(drawing),
            Err(error) => tracing::warn!(%error, "cannot start the thread that draws panels"),
        }
    }

    /// The panel that was begun, once it is done.
    pub(crate) fn drawn(&mut self) -> Option<Drawn> {
        if !self.drawing.as_ref()?.is_finished() {
            return None;
        }
        self.finish()
    }

    /// Waits for the panel in work, if there is one.
    pub(crate) fn finish(&mut self) -> Option<Drawn> {
        let drawn = self.drawing.take()?.join();
        match drawn.unwrap_or_else(|_| Err(anyhow::anyhow!("the thread died"))) {
            Ok(drawn) => Some(drawn),
            Err(error) => {
                tracing::warn!(error = format!("{error:#}"), "a panel cannot be drawn");
                None
            }
        }
    }
}

/// Mean squared error of each frame over all sequences; `predicted: [B T, C, H, W]`, `truth: [B, T, C, H, W]`.
fn error(predicted: &Tensor, truth: &Tensor) -> Vec<f64> {
    let squared = (predicted.view_as(truth) - truth).square();
    let per_frame = squared.mean_dim([0_i64, 2, 3, 4].as_slice(), false, Kind::Double);
    let mut values = vec![0.0_f64; per_frame.numel()];
    let count = values.len();
    per_frame.copy_data(&mut values, count);
    values
}

/// Checks what an actor sent.
fn facts(
    frames: u64,
    report: &v1::EpisodeReport,
    film: &v1::EpisodeFilm,
) -> anyhow::Result<EpisodeFacts> {
    let (steps, window) = (report.length as usize, film.window as usize);
    ensure!(
        film.attention.len() == steps * window,
        "{} attention weights came for {steps} steps and a window of {window}",
        film.attention.len()
    );
    ensure!(
        film.gate.is_empty() || film.gate.len() == steps,
        "{} gate openings came for {steps} steps",
        film.gate.len()
    );
    let policy = report
        .policy
        .context("the episode was driven by no policy")?;
    Ok(EpisodeFacts {
        frames,
        updates: policy.version,
        score: report.score,
        length: report.length,
        end_reason: report.end_reason.clone(),
        fps: film.fps,
        window: film.window,
        attention: film
            .attention
            .chunks(window.max(1))
            .map(<[f32]>::to_vec)
            .collect(),
        gate: film.gate.clone(),
    })
}

/// Checks what an actor found.
fn probe_facts(
    frames: u64,
    report: &v1::EpisodeReport,
    found: &v1::Probe,
) -> anyhow::Result<ProbeFacts> {
    let plans = found.plans.len();
    for state in &found.states {
        let returns = || state.real.iter().chain(&state.imagined);
        ensure!(
            state.real.len() == plans && state.imagined.len() == plans,
            "{} returns came for {plans} plans",
            returns().count()
        );
        ensure!(
            returns().all(|value| value.is_finite()),
            "a return is no number"
        );
    }
    ensure!(plans > 0 && !found.states.is_empty(), "nothing was probed");
    let policy = report
        .policy
        .context("the episode was driven by no policy")?;
    let states = found.states.iter().map(|state| ProbedState {
        kind: state.kind.clone(),
        real: state.real.clone(),
        imagined: state.imagined.clone(),
    });
    let probe = Probe {
        horizon: found.horizon,
        plans: found.plans.clone(),
        states: states.collect(),
    };
    Ok(ProbeFacts {
        frames,
        updates: policy.version,
        report: probe.report(),
        states: probe.states,
    })
}
