//! Cutting episodes into chunks.

use isodream_core::{Chunk, EpisodeId, Step, Steps, codec, derive_seed};

/// Builds the chunks of one environment's episodes.
#[derive(Debug)]
pub(crate) struct ChunkBuilder {
    actor_id: String,
    /// Drawn when the process started, so that no episode of another process has the same name.
    entropy: u64,
    environment: usize,
    chunk_steps: usize,
    episodes: u64,
    episode_id: EpisodeId,
    first_step: u32,
    pending: Steps,
}

impl ChunkBuilder {
    pub(crate) fn new(
        actor_id: &str,
        entropy: u64,
        environment: usize,
        chunk_steps: usize,
        image_bytes: usize,
        action_dim: usize,
    ) -> Self {
        Self {
            actor_id: actor_id.to_owned(),
            entropy,
            environment,
            chunk_steps,
            episodes: 0,
            episode_id: 0,
            first_step: 0,
            pending: Steps::new(image_bytes, action_dim),
        }
    }

    pub(crate) fn actor_id(&self) -> &str {
        &self.actor_id
    }

    /// The episode of the newest step.
    pub(crate) fn episode_id(&self) -> EpisodeId {
        self.episode_id
    }

    /// Adds a step; returns a chunk when one is full or the episode ends.
    pub(crate) fn push(&mut self, step: &Step) -> Option<Chunk> {
        if step.is_first {
            self.episode_id = derive_seed(
                self.entropy,
                &[
                    "episode",
                    &self.actor_id,
                    &self.environment.to_string(),
                    &self.episodes.to_string(),
                ],
            );
            self.episodes += 1;
            self.first_step = 0;
        }
        self.pending.push(step);
        if self.pending.len < self.chunk_steps && !step.is_last {
            return None;
        }
        self.cut(step.is_last)
    }

    /// The pending steps as a chunk, if there are any.
    pub(crate) fn cut(&mut self, ends_episode: bool) -> Option<Chunk> {
        if self.pending.len == 0 {
            return None;
        }
        let empty = Steps::new(self.pending.image_bytes, self.pending.action_dim);
        let steps = std::mem::replace(&mut self.pending, empty);
        let first_step = self.first_step;
        self.first_step += steps.len as u32;
        Some(Chunk {
            actor_id: self.actor_id.clone(),
            // The append client counts the chunks of all environments.
            epoch: 0,
            seq: 0,
            episode_id: self.episode_id,
            first_step,
            steps: steps.len as u32,
            ends_episode,
            payload: codec::encode(&steps),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(index: usize, last: usize) -> Step {
        Step {
            image: vec![index as u8; 12],
            action: vec![0.5],
            reward: index as f32,
            discount: 1.0,
            is_first: index == 0,
            is_last: index == last,
            is_terminal: false,
        }
    }

    #[test]
    fn an_episode_that_is_cut_keeps_its_steps_and_the_next_begins_anew() {
        let mut builder = ChunkBuilder::new("a", 1, 0, 4, 12, 1);
        assert_eq!(builder.cut(false), None);
        let full: Vec<_> = (0..6).filter_map(|i| builder.push(&step(i, 9))).collect();
        let rest = builder.cut(false).expect("two steps were pending");
        assert_eq!(full.len(), 1);
        assert_eq!(
            (rest.first_step, rest.steps, rest.ends_episode),
            (4, 2, false)
        );
        assert_eq!(rest.episode_id, full[0].episode_id);
        assert_eq!(builder.push(&step(0, 9)), None);
        let next = builder.cut(false).expect("one step is pending");
        assert_eq!((next.first_step, next.steps), (0, 1));
        assert_ne!(next.episode_id, rest.episode_id);
    }

    #[test]
    fn chunks_cover_an_episode_without_gaps() {
        let mut builder = ChunkBuilder::new("a", 1, 0, 4, 12, 1);
        let mut ids = Vec::new();
        for _ in 0..2 {
            let chunks: Vec<Chunk> = (0..=9).filter_map(|i| builder.push(&step(i, 9))).collect();
            let ranges: Vec<_> = chunks
                .iter()
                .map(|c| (c.first_step, c.steps, c.ends_episode))
                .collect();
            assert_eq!(ranges, [(0, 4, false), (4, 4, false), (8, 2, true)]);
            let rewards: Vec<f32> = chunks
                .iter()
                .flat_map(|c| codec::decode(&c.payload).expect("own payload").rewards)
                .collect();
            assert_eq!(rewards, (0..10).map(|i| i as f32).collect::<Vec<_>>());
            ids.push(chunks[0].episode_id);
        }
        assert_ne!(ids[0], ids[1], "episodes have ids of their own");
    }
}
