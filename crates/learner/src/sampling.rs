//! The sample stream: sequences from replay, decoded and laid out as tensors beside training, in order.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context, bail};
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use isodream_core::EnvSpec;
use isodream_core::codec::Decoder;
use isodream_model::batch::{StagedShape, StagedSteps};
use isodream_rpc::{SampleClient, SampleWatch, SampledSequence};
use tch::Device;

/// A batch that is ready for training.
#[derive(Debug)]
pub(crate) struct StagedBatch {
    /// Its sequences.
    pub(crate) steps: StagedSteps,
    /// Steps drawn under the limiter up to and with this batch, by the store's id, of the stores that it is from.
    pub(crate) sampled_steps: BTreeMap<String, u64>,
}

struct Job {
    index: u64,
    sequences: Vec<SampledSequence>,
}

type Decoded = (u64, anyhow::Result<StagedBatch>);

/// Batches in the order in which their sequences arrived, whichever thread decoded them.
pub(crate) struct BatchStream {
    decoded: Receiver<Decoded>,
    early: BTreeMap<u64, anyhow::Result<StagedBatch>>,
    next: u64,
    watch: SampleWatch,
}

/// What a batch is made of.
#[derive(Debug, Clone)]
pub(crate) struct BatchShape {
    pub(crate) batch_size: usize,
    pub(crate) batch_length: usize,
    pub(crate) spec: EnvSpec,
    /// Where training will want it.
    pub(crate) device: Device,
}

impl BatchStream {
    /// Starts a thread that draws from `client` and `threads` that decode; at most `prefetch` batches wait.
    pub(crate) fn start(
        client: SampleClient,
        shape: &BatchShape,
        threads: usize,
        prefetch: usize,
    ) -> anyhow::Result<Self> {
        let watch = client.watch();
        let (jobs, queue) = bounded::<Job>(threads);
        let (done, decoded) = bounded::<Decoded>(prefetch);
        let (size, failed) = (shape.batch_size, done.clone());
        std::thread::Builder::new()
            .name("sampler".into())
            .spawn(move || draw(client, size, &jobs, &failed))
            .context("cannot start the sampler thread")?;
        for index in 0..threads {
            let (queue, done, shape) = (queue.clone(), done.clone(), shape.clone());
            std::thread::Builder::new()
                .name(format!("decoder-{index}"))
                .spawn(move || {
                    let mut decoder = Decoder::default();
                    for job in queue {
                        let batch = decode(&job.sequences, &shape, &mut decoder);
                        if done.send((job.index, batch)).is_err() {
                            return;
                        }
                    }
                })
                .context("cannot start a decoder thread")?;
        }
        Ok(Self {
            decoded,
            early: BTreeMap::new(),
            next: 0,
            watch,
        })
    }

    /// The next batch; none if it did not come within `patience`.
    ///
    /// # Errors
    /// Where replay refused this learner, or a whole batch could not be decoded.
    pub(crate) fn next(&mut self, patience: Duration) -> anyhow::Result<Option<StagedBatch>> {
        loop {
            if let Some(batch) = self.early.remove(&self.next) {
                self.next += 1;
                return batch.map(Some);
            }
            match self.decoded.recv_timeout(patience) {
                Ok((index, batch)) => {
                    self.early.insert(index, batch);
                }
                Err(RecvTimeoutError::Timeout) => return Ok(None),
                Err(RecvTimeoutError::Disconnected) => bail!("the sample stream ended"),
            }
        }
    }

    /// Why no batch comes, in words.
    pub(crate) fn waiting(&self) -> Option<String> {
        self.watch.waiting()
    }
}

fn draw(mut client: SampleClient, batch_size: usize, jobs: &Sender<Job>, failed: &Sender<Decoded>) {
    for index in 0.. {
        let drawn: Result<Vec<_>, _> = (0..batch_size).map(|_| client.next_blocking()).collect();
        match drawn {
            Ok(sequences) => {
                if jobs.send(Job { index, sequences }).is_err() {
                    return;
                }
            }
            Err(error) => {
                // Nobody listens any more if the learner is shutting down.
                let _ = failed.send((index, Err(error.into())));
                return;
            }
        }
    }
}

fn decode(
    sequences: &[SampledSequence],
    shape: &BatchShape,
    decoder: &mut Decoder,
) -> anyhow::Result<StagedBatch> {
    let staged = StagedShape {
        sequences: sequences.len(),
        length: shape.batch_length,
        side: shape.spec.image.height,
        action_dim: shape.spec.action_dim,
    };
    let steps = StagedSteps::write(staged, shape.device, |index, rows| {
        let decoded = sequences[index].decode_into(decoder, rows);
        // One bad chunk must not stop a run: the batch goes on without it.
        if let Err(error) = &decoded {
            tracing::error!(%error, "skipping a sequence");
        }
        decoded.is_ok()
    })
    .with_context(|| {
        format!(
            "none of {} sampled sequences could be decoded",
            sequences.len()
        )
    })?;
    Ok(StagedBatch {
        steps,
        // In their order, so that the last of each store stays.
        sampled_steps: sequences
            .iter()
            .map(|sequence| (sequence.store_id.to_string(), sequence.sampled_steps))
            .collect(),
    })
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use isodream_core::{Chunk, ImageShape, Step, Steps, codec};

    use super::*;

    fn shape() -> BatchShape {
        BatchShape {
            batch_size: 2,
            batch_length: 5,
            spec: EnvSpec {
                id: "test".into(),
                image: ImageShape {
                    height: 2,
                    width: 2,
                    channels: 3,
                },
                action_dim: 1,
                action_repeat: 1,
                time_limit: 10,
            },
            device: Device::Cpu,
        }
    }

    fn chunk(first: usize, len: usize) -> Chunk {
        let mut steps = Steps::new(12, 1);
        for index in first..first + len {
            steps.push(&Step {
                image: vec![index as u8; 12],
                action: vec![0.0],
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
            episode_id: 1,
            start_step: offset,
            probability: 1.0,
            chunks: vec![chunk(0, 3), chunk(3, 3), chunk(6, 3)],
            offset,
            store_id: "store".into(),
            sampled_steps: 5,
        }
    }

    #[test]
    fn one_damaged_chunk_is_left_out_and_only_damage_is_an_error() {
        let mut decoder = Decoder::default();
        let mut damaged = sequence(0);
        damaged.chunks[1].payload = Bytes::from_static(b"rubbish");
        let batch =
            decode(&[damaged.clone(), sequence(1)], &shape(), &mut decoder).expect("one is valid");
        let rewards = batch.steps.to_batch(Device::Cpu).rewards;
        assert_eq!(rewards.size(), [1, 5]);
        assert_eq!(rewards.double_value(&[0, 0]), 1.0);
        assert!(decode(&[damaged], &shape(), &mut decoder).is_err());
    }
}
