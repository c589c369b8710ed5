//! The shared encoder stem and the tails of the three branches (`Enc_theta`, `Enc_phi1..3`).

use isodream_core::config::ModelConfig;
use tch::{Kind, Tensor};

use crate::nn::{Conv, elu};
use crate::params::Scope;

/// Width of a branch's embedding for a first layer of `cnn_depth` channels.
pub fn embed_dim(config: &ModelConfig) -> i64 {
    8 * config.cnn_depth * 2 * 2
}

/// Each picture of a sequence with the `frames - 1` right before it, the newest first; grey where there is none.
///
/// # Shapes
/// `[B, T, 3, side, side] -> [B, T, 3 frames, side, side]`
pub fn stack_frames(images: &Tensor, frames: i64) -> Tensor {
    if frames == 1 {
        return images.shallow_clone();
    }
    let (length, earlier) = (images.size()[1], frames - 1);
    // Two numbers per axis, the last axis first: only time is padded, before its first step.
    let padded = images.constant_pad_nd([0, 0, 0, 0, 0, 0, earlier, 0]);
    let back = |steps: i64| padded.narrow(1, earlier - steps, length);
    Tensor::cat(&(0..frames).map(back).collect::<Vec<_>>(), 2)
}

/// The first convolutions, shared by all branches: two for pictures of 64 pixels, one for pictures of 32.
#[derive(Debug)]
pub struct Stem {
    layers: Vec<Conv>,
}

impl Stem {
    /// The stem for RGB images of `side` rows and columns, 32 or 64.
    pub fn new(mut scope: Scope<'_>, config: &ModelConfig, side: i64) -> Self {
        let depth = config.cnn_depth;
        let seen = 3 * config.encoder_frames;
        let channels: &[i64] = if side == 32 {
            &[seen, 2 * depth]
        } else {
            &[seen, depth, 2 * depth]
        };
        let layer = |(index, pair): (usize, &[i64])| {
            Conv::new(scope.sub(format!("conv{index}")), pair[0], pair[1])
        };
        Self {
            layers: channels.windows(2).enumerate().map(layer).collect(),
        }
    }

    /// # Shapes
    /// [`stack_frames`]'s `[N, 3 frames, 64, 64] -> [N, 2 depth, 14, 14]`, or `[N, 3 frames, 32, 32] -> [N, 2 depth, 15, 15]`
    pub fn forward(&self, image: &Tensor) -> Tensor {
        self.layers
            .iter()
            .fold(image.shallow_clone(), |x, layer| elu(layer.forward(&x)))
    }
}

/// The last two convolutions of one branch.
#[derive(Debug)]
pub struct Tail {
    conv2: Conv,
    conv3: Conv,
}

impl Tail {
    /// A tail that sees `action_dim` action planes (0 for none).
    pub fn new(mut scope: Scope<'_>, config: &ModelConfig, action_dim: i64) -> Self {
        let depth = config.cnn_depth;
        Self {
            conv2: Conv::new(scope.sub("conv2"), 2 * depth + action_dim, 4 * depth),
            conv3: Conv::new(scope.sub("conv3"), 4 * depth, 8 * depth),
        }
    }

    /// # Shapes
    /// `stem: [N, 2 depth, 14 or 15, ..]`, `action: [N, A]` `-> [N, 32 depth]`
    pub fn forward(&self, stem: &Tensor, action: Option<&Tensor>) -> Tensor {
        let x = match action {
            Some(action) => self.conv2.forward_with_planes(stem, action),
            None => self.conv2.forward(stem),
        };
        elu(self.conv3.forward(&elu(x)))
            .flatten(1, -1)
            .to_kind(Kind::Float)
    }
}

/// What a policy needs of the encoder: the stem and the tails of both dynamic branches.
#[derive(Debug)]
pub struct Encoder {
    /// The shared part.
    pub stem: Stem,
    controllable: Tail,
    noncontrollable: Tail,
    actions: bool,
}

/// Embeddings of the two dynamic branches, `[N, 32 depth]` each.
#[derive(Debug)]
pub struct Embeddings {
    /// For the posterior `q(s_t)`.
    pub controllable: Tensor,
    /// For the posterior `q(z_t)`.
    pub noncontrollable: Tensor,
}

impl Encoder {
    /// The encoder of `config` for pictures of `side` rows and columns.
    pub fn new(mut scope: Scope<'_>, config: &ModelConfig, side: i64, action_dim: i64) -> Self {
        let planes = if config.encoder_actions {
            action_dim
        } else {
            0
        };
        Self {
            stem: Stem::new(scope.sub("stem"), config, side),
            controllable: Tail::new(scope.sub("controllable"), config, planes),
            noncontrollable: Tail::new(scope.sub("noncontrollable"), config, planes),
            actions: config.encoder_actions,
        }
    }

    /// Embeds stem outputs with the actions that led to them.
    ///
    /// # Shapes
    /// `stem: [N, 2 depth, 14 or 15, ..]`, `action: [N, A]`
    pub fn embed(&self, stem: &Tensor, action: &Tensor) -> Embeddings {
        let action = self.actions.then_some(action);
        Embeddings {
            controllable: self.controllable.forward(stem, action),
            noncontrollable: self.noncontrollable.forward(stem, action),
        }
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn a_picture_is_seen_with_those_before_it() {
        // Two sequences of four steps, numbered 1 to 8 in all pixels of all channels.
        let numbers = Tensor::arange(8, (Kind::Float, Device::Cpu)) + 1.0;
        let images = numbers.view([2, 4, 1, 1, 1]).expand([2, 4, 3, 2, 2], false);
        assert!(stack_frames(&images, 1).equal(&images));
        let seen = stack_frames(&images, 3);
        assert_eq!(seen.size(), [2, 4, 9, 2, 2]);
        for (sequence, first) in [(0, 1.0), (1, 5.0)] {
            for t in 0..4 {
                for back in 0..3 {
                    let wanted = if back > t {
                        0.0
                    } else {
                        first + (t - back) as f64
                    };
                    let block = seen.get(sequence).get(t).narrow(0, 3 * back, 3);
                    assert!(
                        block.eq(wanted).all().int64_value(&[]) == 1,
                        "{sequence} {t} {back}"
                    );
                }
            }
        }
    }
}
