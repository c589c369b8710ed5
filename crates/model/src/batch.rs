//! What the learner trains on: sequences of pictures, actions and rewards as tensors.

use isodream_core::Steps;
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

impl StagedSteps {
    /// Lays out equally long sequences of RGB images with `side` rows and columns, for a training step on `device`: a
    /// GPU fetches them from page-locked memory without waiting.
    ///
    /// # Panics
    /// If the sequences differ in length or sizes: a defect of the caller.
    pub fn new(sequences: &[Steps], side: i64, device: Device) -> Self {
        let batch = sequences.len() as i64;
        let length = sequences[0].len as i64;
        let staged = |tensor: Tensor| match device {
            Device::Cuda(_) => tensor.pin_memory(device),
            _ => tensor,
        };
        let column = |part: fn(&Steps) -> &Vec<f32>, width: i64| {
            let values: Vec<f32> = sequences
                .iter()
                .flat_map(|s| part(s).iter().copied())
                .collect();
            staged(Tensor::from_slice(&values).view([batch, length, width]))
        };
        let pixels: Vec<&[u8]> = sequences.iter().map(|s| s.images.as_slice()).collect();
        let pixels = Tensor::from_slice(&pixels.concat()).view([batch, length, side, side, 3]);
        Self {
            pixels: staged(pixels),
            actions: column(|s| &s.actions, sequences[0].action_dim as i64),
            rewards: column(|s| &s.rewards, 1).squeeze_dim(-1),
            discounts: column(|s| &s.discounts, 1).squeeze_dim(-1),
        }
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

#[cfg(test)]
mod tests {
    use isodream_core::Step;

    use super::*;

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
