//! What the learner trains on: sequences of pictures, actions and rewards as tensors.

use std::marker::PhantomData;

use isodream_core::Steps;
use isodream_core::codec::Rows;
use tch::kind::Element;
use tch::{Device, Kind, Tensor};

/// A batch of sequences.
#[derive(Debug)]
pub struct Batch {
    /// `[B, T, 3, 64, 64]` in `[-0.5, 0.5]`.
    pub images: Tensor,
    /// `[B, T, A]`: row t led to image t.
    pub actions: Tensor,
    /// `[B, T]`.
    pub rewards: Tensor,
    /// `[B, T]`: 0 where the episode really ended, else 1.
    pub discounts: Tensor,
}

impl Batch {
    /// Sequences (B).
    pub fn sequences(&self) -> i64 {
        self.images.size()[0]
    }

    /// A view of its first `sequences`.
    pub fn first(&self, sequences: i64) -> Self {
        self.rows(0, sequences.min(self.sequences()))
    }

    /// Views of at most `parts` parts, as equal as can be and none of them empty.
    pub fn split(&self, parts: usize) -> Vec<Self> {
        let total = self.sequences();
        let parts = (parts as i64).clamp(1, total);
        let end = |part: i64| total * part / parts;
        (0..parts)
            .map(|part| self.rows(end(part), end(part + 1) - end(part)))
            .collect()
    }

    fn rows(&self, first: i64, count: i64) -> Self {
        let rows = |x: &Tensor| x.narrow(0, first, count);
        Self {
            images: rows(&self.images),
            actions: rows(&self.actions),
            rewards: rows(&self.rewards),
            discounts: rows(&self.discounts),
        }
    }
}

/// Pixels as the networks take them: `[N, H, W, 3]` bytes to `[N, 3, H, W]` floats in `[-0.5, 0.5]`, the
/// channels adjacent in memory as they were.
pub fn preprocess(pixels: &Tensor) -> Tensor {
    (pixels.to_kind(Kind::Float) / 255.0 - 0.5).permute([0, 3, 1, 2])
}

/// Sequences laid out as tensors in the CPU's memory: what can be done beside training.
#[derive(Debug)]
pub struct StagedSteps {
    /// Bytes, `[B, T, H, W, 3]`.
    pixels: Tensor,
    actions: Tensor,
    rewards: Tensor,
    discounts: Tensor,
}

/// Sizes of a batch.
#[derive(Debug, Clone, Copy)]
pub struct StagedShape {
    /// Sequences (B).
    pub sequences: usize,
    /// Steps per sequence (T).
    pub length: usize,
    /// Rows and columns of an RGB image.
    pub side: usize,
    /// Action dimensions (A).
    pub action_dim: usize,
}

impl StagedSteps {
    /// A batch whose sequences `write` puts in their places one by one, for a training step on `device`: a GPU fetches
    /// them from page-locked memory without waiting. A sequence for which `write` says false is left out; none if
    /// all are.
    pub fn write(
        shape: StagedShape,
        device: Device,
        mut write: impl FnMut(usize, Rows<'_>) -> bool,
    ) -> Option<Self> {
        let StagedShape {
            sequences,
            length,
            side,
            action_dim,
        } = shape;
        let (image_bytes, steps) = (3 * side * side, sequences * length);
        let mut pixels = Memory::<u8>::new(steps * image_bytes);
        let mut actions = Memory::<f32>::new(steps * action_dim);
        let mut rewards = Memory::<f32>::new(steps);
        let mut discounts = Memory::<f32>::new(steps);
        let mut written = 0;
        for index in 0..sequences {
            let rows = written * length..(written + 1) * length;
            let place = Rows {
                images: &mut pixels.slice()[rows.start * image_bytes..rows.end * image_bytes],
                actions: &mut actions.slice()[rows.start * action_dim..rows.end * action_dim],
                rewards: &mut rewards.slice()[rows.clone()],
                discounts: &mut discounts.slice()[rows],
            };
            written += usize::from(write(index, place));
        }
        let [batch, steps, side, dim] =
            [sequences, length, side, action_dim].map(|size| size as i64);
        let staged = |tensor: Tensor, shape: &[i64]| {
            let tensor = tensor.view(shape).narrow(0, 0, written as i64);
            match device {
                Device::Cuda(_) => tensor.pin_memory(device),
                _ => tensor,
            }
        };
        (written > 0).then(|| Self {
            pixels: staged(pixels.tensor, &[batch, steps, side, side, 3]),
            actions: staged(actions.tensor, &[batch, steps, dim]),
            rewards: staged(rewards.tensor, &[batch, steps]),
            discounts: staged(discounts.tensor, &[batch, steps]),
        })
    }

    /// A batch of equally long sequences of RGB images with `side` rows and columns.
    ///
    /// # Panics
    /// If there is none, or if they differ in length or sizes: a defect of the caller.
    pub fn new(sequences: &[Steps], side: usize, device: Device) -> Self {
        let shape = StagedShape {
            sequences: sequences.len(),
            length: sequences[0].len,
            side,
            action_dim: sequences[0].action_dim,
        };
        Self::write(shape, device, |index, rows| {
            let steps = &sequences[index];
            rows.images.copy_from_slice(&steps.images);
            rows.actions.copy_from_slice(&steps.actions);
            rows.rewards.copy_from_slice(&steps.rewards);
            rows.discounts.copy_from_slice(&steps.discounts);
            true
        })
        .expect("there is a sequence")
    }

    /// The batch on `device`; a GPU is not waited for.
    pub fn to_batch(&self, device: Device) -> Batch {
        let moved = |x: &Tensor| x.to_device_(device, x.kind(), true, false);
        let size = self.pixels.size();
        Batch {
            images: preprocess(&moved(&self.pixels).flatten(0, 1)).unflatten(0, &size[..2]),
            actions: moved(&self.actions),
            rewards: moved(&self.rewards),
            discounts: moved(&self.discounts),
        }
    }
}

/// A new tensor in the CPU's memory that can be written as a slice.
struct Memory<T> {
    tensor: Tensor,
    len: usize,
    element: PhantomData<T>,
}

impl<T: Element> Memory<T> {
    fn new(len: usize) -> Self {
        Self {
            tensor: Tensor::zeros([len as i64], (T::KIND, Device::Cpu)),
            len,
            element: PhantomData,
        }
    }

    fn slice(&mut self) -> &mut [T] {
        // SAFETY: the tensor is contiguous, initialised, on the CPU, has `len` elements of the kind of `T`, and
        // nothing else knows it while it is borrowed here.
        unsafe { std::slice::from_raw_parts_mut(self.tensor.data_ptr().cast(), self.len) }
    }
}

#[cfg(test)]
mod tests {
    use isodream_core::Step;

    use super::*;

    #[test]
    fn refused_sequences_are_left_out() {
        let shape = StagedShape {
            sequences: 3,
            length: 2,
            side: 1,
            action_dim: 1,
        };
        let write = |refused: usize| {
            StagedSteps::write(shape, Device::Cpu, |index, rows| {
                rows.rewards.fill(index as f32);
                index != refused && refused < 3
            })
        };
        let batch = write(1).expect("two are written").to_batch(Device::Cpu);
        assert_eq!(batch.rewards.size(), [2, 2]);
        assert_eq!(batch.rewards.double_value(&[1, 1]), 2.0);
        assert_eq!(batch.images.size(), [2, 2, 3, 1, 1]);
        assert!(write(3).is_none());
    }

    #[test]
    fn steps_arrive_where_they_belong() {
        let sequence = |start: u8| {
            let mut steps = Steps::new(12, 2);
            for t in start..start + 3 {
                steps.push(&Step {
                    image: (0..12).map(|i| 20 * t + i).collect(),
                    action: vec![f32::from(t), -f32::from(t)],
                    reward: f32::from(t) / 2.0,
                    discount: f32::from(u8::from(t != 4)),
                    is_first: false,
                    is_last: false,
                    is_terminal: false,
                });
            }
            steps
        };
        let batch =
            StagedSteps::new(&[sequence(0), sequence(4)], 2, Device::Cpu).to_batch(Device::Cpu);
        assert_eq!(batch.images.size(), [2, 3, 3, 2, 2]);
        assert_eq!(batch.actions.double_value(&[1, 2, 1]), -6.0);
        assert_eq!(batch.rewards.double_value(&[1, 0]), 2.0);
        assert_eq!(batch.discounts.double_value(&[1, 0]), 0.0);
        assert_eq!(batch.discounts.double_value(&[1, 1]), 1.0);
        // Row 1, column 0 of channel 2 is the ninth byte.
        let pixel = f64::from(20 * 5 + 8) / 255.0 - 0.5;
        let found = batch.images.double_value(&[1, 1, 2, 1, 0]);
        assert!((found - pixel).abs() < 1e-6, "{found} {pixel}");
    }
}
