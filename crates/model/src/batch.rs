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

impl Batch {
    /// Makes a batch of equally long sequences of RGB images with `side` rows and columns.
    ///
    /// # Panics
    /// If the sequences differ in length or sizes: a defect of the caller.
    pub fn new(sequences: &[Steps], side: i64, device: Device) -> Self {
        let batch = sequences.len() as i64;
        let length = sequences[0].len as i64;
        let column = |part: fn(&Steps) -> &Vec<f32>, width: i64| {
            let values: Vec<f32> = sequences
                .iter()
                .flat_map(|s| part(s).iter().copied())
                .collect();
            Tensor::from_slice(&values)
                .view([batch, length, width])
                .to_device(device)
        };
        let pixels: Vec<u8> = sequences
            .iter()
            .flat_map(|s| s.images.iter().copied())
            .collect();
        let pixels = Tensor::from_slice(&pixels)
            .view([batch * length, side, side, 3])
            .to_device(device);
        Self {
            images: preprocess(&pixels).unflatten(0, [batch, length]),
            actions: column(|s| &s.actions, sequences[0].action_dim as i64),
            rewards: column(|s| &s.rewards, 1).squeeze_dim(-1),
            discounts: column(|s| &s.discounts, 1).squeeze_dim(-1),
        }
    }
}
