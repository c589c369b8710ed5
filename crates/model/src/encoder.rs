//! The shared encoder stem and the tails of the three branches (`Enc_theta`, `Enc_phi1..3`).

use isodream_core::config::ModelConfig;
use tch::{Kind, Tensor};

use crate::nn::{Conv, elu};
use crate::params::Scope;

/// Width of a branch's embedding for a first layer of `cnn_depth` channels.
pub fn embed_dim(config: &ModelConfig) -> i64 {
    8 * config.cnn_depth * 2 * 2
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
        let channels: &[i64] = if side == 32 {
            &[3, 2 * depth]
        } else {
            &[3, depth, 2 * depth]
        };
        let layer = |(index, pair): (usize, &[i64])| {
            Conv::new(scope.sub(format!("conv{index}")), pair[0], pair[1])
        };
        Self {
            layers: channels.windows(2).enumerate().map(layer).collect(),
        }
    }

    /// # Shapes
    /// `[N, 3, 64, 64] -> [N, 2 depth, 14, 14]`, or `[N, 3, 32, 32] -> [N, 2 depth, 15, 15]`
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
