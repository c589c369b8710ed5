//! The running episode of one environment.

use isodream_core::{Chunk, Config, EnvSpec, EpisodeId, Step};
use isodream_envs::{EndReason, Transition};
use tracing::{Span, field};

use crate::chunks::ChunkBuilder;
use crate::rollout::Outcome;

/// Rows of one environment on their way into chunks.
#[derive(Debug)]
pub(crate) struct Lane {
    builder: ChunkBuilder,
    /// Chunks to hand over.
    chunks: Vec<Chunk>,
    newest: Step,
    action_dim: usize,
    score: f64,
    length: u32,
    end_reason: Option<EndReason>,
    /// Of the running episode.
    span: Span,
}

impl Lane {
    /// A lane that waits for [`Lane::begin`].
    pub(crate) fn new(
        actor_id: &str,
        entropy: u64,
        environment: usize,
        config: &Config,
        spec: &EnvSpec,
    ) -> Self {
        Self {
            builder: ChunkBuilder::new(
                actor_id,
                entropy,
                environment,
                config.replay.chunk_steps,
                spec.image.bytes(),
                spec.action_dim,
            ),
            chunks: Vec::new(),
            newest: row(Transition::first(Vec::new()), Vec::new(), true),
            action_dim: spec.action_dim,
            score: 0.0,
            length: 0,
            end_reason: None,
            span: Span::none(),
        }
    }

    /// The row that the policy has to answer.
    pub(crate) fn newest(&self) -> &Step {
        &self.newest
    }

    /// Chunks that became full since the last call.
    pub(crate) fn take_chunks(&mut self) -> Vec<Chunk> {
        std::mem::take(&mut self.chunks)
    }

    /// Row 0 of an episode.
    pub(crate) fn begin(&mut self, first: Transition) {
        (self.score, self.length, self.end_reason) = (0.0, 0, None);
        self.span = tracing::debug_span!(
            "episode",
            actor = self.builder.actor_id(),
            score = field::Empty,
            steps = field::Empty
        );
        let action = vec![0.0; self.action_dim];
        self.push(row(first, action, true));
    }

    /// The row that `action` led to.
    pub(crate) fn go_on(&mut self, transition: Transition, action: Vec<f32>) {
        self.score += f64::from(transition.reward);
        self.length += 1;
        self.end_reason = transition.end_reason;
        self.push(row(transition, action, false));
    }

    /// The episode that the newest row ended, and what it came to.
    pub(crate) fn finish(&self, metrics: Vec<(&'static str, f64)>) -> (EpisodeId, Outcome) {
        self.span.record("score", self.score);
        self.span.record("steps", self.length);
        let outcome = Outcome {
            score: self.score,
            length: self.length,
            end_reason: self.end_reason,
            metrics: metrics
                .into_iter()
                .map(|(name, value)| (name.to_owned(), value))
                .collect(),
        };
        (self.builder.episode_id(), outcome)
    }

    /// Ends an episode whose environment failed. Its rows so far are sound, and stay.
    pub(crate) fn abandon(&mut self) {
        self.chunks.extend(self.builder.cut(false));
    }

    fn push(&mut self, step: Step) {
        self.chunks.extend(self.builder.push(&step));
        self.newest = step;
    }
}

fn row(transition: Transition, action: Vec<f32>, is_first: bool) -> Step {
    Step {
        image: transition.image,
        action,
        reward: transition.reward,
        discount: transition.discount,
        is_first,
        is_last: transition.is_last,
        is_terminal: transition.is_terminal,
    }
}
