//! The sample stream: sequences from replay, decoded and laid out as tensors beside training, in order.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use isodream_core::{EnvSpec, Steps, codec};
use isodream_model::batch::StagedSteps;
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
                    for job in queue {
                        if done
                            .send((job.index, decode(&job.sequences, &shape)))
                            .is_err()
                        {
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

fn decode(sequences: &[SampledSequence], shape: &BatchShape) -> anyhow::Result<StagedBatch> {
    let mut decoded = Vec::with_capacity(sequences.len());
    for sequence in sequences {
        match trim(sequence, shape) {
            Ok(steps) => decoded.push(steps),
            // One bad chunk must not stop a run: the batch goes on without it.
            Err(error) => tracing::error!(error = format!("{error:#}"), "skipping a sequence"),
        }
    }
    ensure!(
        !decoded.is_empty(),
        "none of {} sampled sequences could be decoded",
        sequences.len()
    );
    let side = shape.spec.image.height as i64;
    Ok(StagedBatch {
        steps: StagedSteps::new(&decoded, side, shape.device),
        // In their order, so that the last of each store stays.
        sampled_steps: sequences
            .iter()
            .map(|sequence| (sequence.store_id.to_string(), sequence.sampled_steps))
            .collect(),
    })
}

/// Decodes the chunks of a sequence and cuts it out.
fn trim(sequence: &SampledSequence, shape: &BatchShape) -> anyhow::Result<Steps> {
    let (image_bytes, action_dim) = (shape.spec.image.bytes(), shape.spec.action_dim);
    let mut steps = Steps::new(image_bytes, action_dim);
    let mut skip = sequence.offset as usize;
    for chunk in &sequence.chunks {
        let name = || {
            format!(
                "chunk {} of {} in epoch {}",
                chunk.seq, chunk.actor_id, chunk.epoch
            )
        };
        let decoded = codec::decode(&chunk.payload).with_context(name)?;
        ensure!(
            decoded.image_bytes == image_bytes && decoded.action_dim == action_dim,
            "{} is of another environment",
            name()
        );
        let first = skip.min(decoded.len);
        skip -= first;
        let last = decoded.len.min(first + shape.batch_length - steps.len);
        steps.extend(&decoded, first..last);
    }
    ensure!(
        steps.len == shape.batch_length,
        "a sampled sequence has {} steps instead of {}",
        steps.len,
        shape.batch_length
    );
    Ok(steps)
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use isodream_core::{Chunk, ImageShape, Step};

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
    fn a_sequence_is_cut_out_over_chunk_borders() {
        for offset in 0..=4 {
            let steps = trim(&sequence(offset), &shape()).expect("valid");
            let expected: Vec<f32> = (0..5).map(|i| (offset + i) as f32).collect();
            assert_eq!(steps.rewards, expected);
            assert_eq!(steps.images[0], offset as u8);
        }
        assert!(
            trim(&sequence(5), &shape()).is_err(),
            "only four steps are left"
        );
    }

    #[test]
    fn one_damaged_chunk_is_left_out_and_only_damage_is_an_error() {
        let mut damaged = sequence(0);
        damaged.chunks[1].payload = Bytes::from_static(b"rubbish");
        let batch = decode(&[sequence(1), damaged.clone()], &shape()).expect("one is valid");
        assert_eq!(batch.steps.to_batch(Device::Cpu).rewards.size(), [1, 5]);
        assert!(decode(&[damaged], &shape()).is_err());
    }
}
