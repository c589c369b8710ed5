//! Cutting a drawn sequence out of its chunks.

use isodream_core::codec::{DecodeError, Decoder, Payload, Rows};

use crate::SampledSequence;

/// A sequence that is not what was asked for.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum SequenceError {
    /// A chunk's payload is damaged.
    #[error("chunk {seq} of {actor_id} in epoch {epoch}: {source}")]
    Chunk {
        /// Who collected it.
        actor_id: String,
        /// Start of the actor.
        epoch: u64,
        /// Number of the chunk.
        seq: u64,
        /// What is wrong with it.
        source: DecodeError,
    },
    /// A chunk's images or actions have other sizes.
    #[error("chunk {seq} of {actor_id} in epoch {epoch} is of another environment")]
    OtherEnvironment {
        /// Who collected it.
        actor_id: String,
        /// Start of the actor.
        epoch: u64,
        /// Number of the chunk.
        seq: u64,
    },
    /// The chunks end before the sequence does.
    #[error("a sampled sequence has {found} steps instead of {wanted}")]
    Short {
        /// Steps that are there.
        found: usize,
        /// Steps that were asked for.
        wanted: usize,
    },
}

impl SampledSequence {
    /// Decodes the sequence into `rows`, for example its place in a batch. `rows.rewards` says how many steps, and
    /// with the other columns how large an image and an action are.
    ///
    /// # Errors
    /// [`SequenceError`] where the chunks do not hold what fits into `rows`, which then holds anything.
    ///
    /// # Panics
    /// If the columns of `rows` have different lengths: a defect of the caller.
    pub fn decode_into(&self, decoder: &mut Decoder, rows: Rows<'_>) -> Result<(), SequenceError> {
        let wanted = rows.rewards.len();
        let image_bytes = rows.images.len() / wanted.max(1);
        let action_dim = rows.actions.len() / wanted.max(1);
        let mut rest = rows;
        let mut skip = self.offset as usize;
        for chunk in &self.chunks {
            let damaged = |source| SequenceError::Chunk {
                actor_id: chunk.actor_id.clone(),
                epoch: chunk.epoch,
                seq: chunk.seq,
                source,
            };
            let payload = Payload::parse(&chunk.payload).map_err(damaged)?;
            if payload.image_bytes() != image_bytes || payload.action_dim() != action_dim {
                return Err(SequenceError::OtherEnvironment {
                    actor_id: chunk.actor_id.clone(),
                    epoch: chunk.epoch,
                    seq: chunk.seq,
                });
            }
            let first = skip.min(payload.steps());
            skip -= first;
            let last = payload.steps().min(first + rest.rewards.len());
            let part;
            (part, rest) = rest.split_at(last - first);
            decoder
                .decode_into(&payload, first..last, part)
                .map_err(damaged)?;
        }
        match rest.rewards.len() {
            0 => Ok(()),
            missing => Err(SequenceError::Short {
                found: wanted - missing,
                wanted,
            }),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use bytes::Bytes;
    use isodream_core::{Chunk, Step, Steps, codec};

    use super::*;

    fn chunk(first: usize, len: usize) -> Chunk {
        let mut steps = Steps::new(12, 1);
        for index in first..first + len {
            steps.push(&Step {
                image: vec![index as u8; 12],
                action: vec![-(index as f32)],
                reward: index as f32,
                discount: 1.0,
                is_first: index == 0,
                is_last: false,
                is_terminal: false,
            });
        }
        Chunk {
            actor_id: "a".into(),
            epoch: 1,
            seq: 0,
            episode_id: 1,
            first_step: first as u32,
            steps: len as u32,
            ends_episode: false,
            payload: codec::encode(&steps),
        }
    }

    fn sequence(offset: u32) -> SampledSequence {
        SampledSequence {
            chunks: vec![chunk(0, 3), chunk(3, 3), chunk(6, 3)],
            offset,
            episode_id: 1,
            start_step: offset,
            probability: 1.0,
            store_id: "store".into(),
            sampled_steps: 5,
        }
    }

    /// Five steps: rewards, actions, and the first byte of each image.
    fn decoded(
        sequence: &SampledSequence,
        image_bytes: usize,
    ) -> Result<[Vec<f32>; 3], SequenceError> {
        let mut images = vec![0; 5 * image_bytes];
        let (mut actions, mut rewards, mut discounts) = ([0.0; 5], [0.0; 5], [0.0; 5]);
        let rows = Rows {
            images: &mut images,
            actions: &mut actions,
            rewards: &mut rewards,
            discounts: &mut discounts,
        };
        sequence.decode_into(&mut Decoder::default(), rows)?;
        let pixels = images
            .chunks(image_bytes)
            .map(|i| f32::from(i[0]))
            .collect();
        Ok([rewards.to_vec(), actions.to_vec(), pixels])
    }

    #[test]
    fn a_sequence_is_cut_out_over_chunk_borders() {
        for offset in 0..=4 {
            let expected: Vec<f32> = (0..5).map(|i| (offset + i) as f32).collect();
            let [rewards, actions, pixels] = decoded(&sequence(offset), 12).unwrap();
            assert_eq!(rewards, expected);
            assert_eq!(pixels, expected);
            assert_eq!(actions, expected.iter().map(|x| -x).collect::<Vec<_>>());
        }
        let short = SequenceError::Short {
            found: 4,
            wanted: 5,
        };
        assert_eq!(decoded(&sequence(5), 12), Err(short));
    }

    #[test]
    fn a_damaged_or_foreign_chunk_is_named() {
        let mut damaged = sequence(0);
        damaged.chunks[1].payload = Bytes::from_static(b"rubbish");
        let error = decoded(&damaged, 12).unwrap_err().to_string();
        assert!(
            error.contains("chunk 0 of a in epoch 1: payload is truncated"),
            "{error}"
        );
        assert!(matches!(
            decoded(&sequence(0), 27),
            Err(SequenceError::OtherEnvironment { .. })
        ));
    }
}
