//! The work of one training step, counted from shapes: floating-point operations of its matrix products and
//! convolutions, with nothing computed twice and nothing that nobody uses.
//!
//! A multiplication with an addition counts as 2. A layer whose weights and input both need gradients costs
//! three times its forward pass, one that passes gradients on without learning twice, one without gradients once.

use isodream_core::Config;
use isodream_core::config::{InverseInput, VarianceLoss};

use crate::encoder::embed_dim;
use crate::policy::looks_ahead;

/// Floating-point operations of one update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpdateCost {
    /// Representation learning, forward and backward.
    pub world_model: f64,
    /// Imagination, actor and critic.
    pub behavior: f64,
}

impl UpdateCost {
    /// Of an update of `config`, for environments with `action_dim` actions.
    pub fn new(config: &Config, action_dim: usize) -> Self {
        let learner = &config.learner;
        let frames = (learner.batch_size * learner.batch_length) as f64;
        let macs = Macs::new(config, action_dim as f64);
        let length = learner.batch_length as f64;
        let once_per_sequence = macs.background_decoder / length;
        let background_share = (config.model.background_frames as f64 / length).min(1.0);
        let per_frame = macs.encoder_rest
            + macs.tail * background_share
            + 2.0 * macs.decoder
            + once_per_sequence
            + macs.observe
            + macs.heads;
        let starts = (frames * config.behavior.start_share).ceil().max(1.0);
        let horizon = config.behavior.imagination_horizon as f64;
        let imagined = horizon * macs.imagined_state + (horizon - 1.0) * macs.imagined_step;
        Self {
            // The first convolution's input is the image, which needs no gradient.
            world_model: frames * 2.0 * (2.0 * macs.first_conv + 3.0 * per_frame),
            behavior: starts * 2.0 * imagined,
        }
    }

    /// Both parts.
    pub fn total(&self) -> f64 {
        self.world_model + self.behavior
    }
}

/// Multiply-accumulates of forward passes: per frame for the world model; for behaviour learning, there with the
/// factors of its gradients, per imagined state and per step between two of them.
struct Macs {
    first_conv: f64,
    encoder_rest: f64,
    tail: f64,
    decoder: f64,
    background_decoder: f64,
    observe: f64,
    heads: f64,
    imagined_state: f64,
    imagined_step: f64,
}

impl Macs {
    fn new(config: &Config, action: f64) -> Self {
        let model = &config.model;
        let float = |n: i64| n as f64;
        let (depth, units) = (float(model.cnn_depth), float(model.units));
        let (stoch, deter, hidden) = (float(model.stoch), float(model.deter), float(model.hidden));
        let feat = stoch + deter;
        let embed = float(embed_dim(model));
        let conv = |side: f64, inputs: f64, outputs: f64| side * side * 16.0 * inputs * outputs;
        // A transposed convolution works on its input's pixels.
        let fold = |side: f64, kernel: f64, inputs: f64, outputs: f64| {
            side * side * kernel * kernel * inputs * outputs
        };
        let mlp = |inputs: f64, layers: i64, outputs: f64| {
            (0..layers)
                .fold((inputs, 0.0), |(width, sum), _| {
                    (units, sum + width * units)
                })
                .1
                + if layers > 0 { units } else { inputs } * outputs
        };
        let tail = conv(6.0, 2.0 * depth, 4.0 * depth) + conv(2.0, 4.0 * depth, 8.0 * depth);
        let decoder = |inputs: f64, channels: f64| {
            inputs * 32.0 * depth
                + fold(1.0, 5.0, 32.0 * depth, 4.0 * depth)
                + fold(5.0, 5.0, 4.0 * depth, 2.0 * depth)
                + fold(13.0, 6.0, 2.0 * depth, depth)
                + fold(30.0, 6.0, depth, channels)
        };
        let transition = (stoch + action) * hidden + (hidden + deter) * 3.0 * deter;
        let prior = deter * hidden + hidden * 2.0 * stoch;
        let posterior = (deter + embed) * hidden + hidden * 2.0 * stoch;
        let gate = if model.dependency_gate {
            2.0 * deter + 2.0 * stoch * stoch
        } else {
            0.0
        };
        let head_feat = if model.indicator { 2.0 * feat } else { feat };
        let reward = mlp(head_feat, model.reward_layers, 1.0);
        let inverse_feat = match model.inverse {
            InverseInput::Posterior => 2.0 * stoch,
            InverseInput::EmbedDiff => embed,
        };
        let discount = if model.discount_head {
            mlp(head_feat, model.discount_layers, 1.0)
        } else {
            0.0
        };

        // The paper's form of the variance constraints compares samples, the authors' recurrent states.
        let hypothetical = match config.loss.variance {
            VarianceLoss::Paper => 3.0,
            VarianceLoss::Deter => 0.0,
        };

        // Imagination: dynamics, reward and slow critic pass gradients to the actor without learning.
        let noncontrollable = if model.indicator {
            transition + prior + gate
        } else {
            0.0
        };
        let value = mlp(feat, model.critic_layers, 1.0);
        // Both passes where the value's gradient reaches the actor, else the forward pass alone.
        let valued = if config.behavior.value_gradient {
            2.0
        } else {
            1.0
        };
        let mut imagined_state = 2.0 * (reward + discount) + valued * value;
        // Actor and critic learn; the gradient of neither goes on from their first layers, unless the critic's
        // reaches the attention.
        let first = feat * units;
        let mut imagined_step = 2.0 * (transition + prior + noncontrollable)
            + 3.0 * (mlp(feat, model.actor_layers, 2.0 * action) + value)
            - 2.0 * first;
        if looks_ahead(config) {
            let window = float(config.behavior.rollout_window);
            let dim = float(model.attention_dim);
            // The first transition of the window is the imagined step's own.
            let alone =
                (window - 1.0) * prior + (window - 2.0).max(0.0) * (transition + stoch * stoch);
            // Four projections per query, scores and their mean. The critic's gradient reaches the weights and
            // passes all but the first projection.
            let (project, read) = (4.0 * feat * dim, 2.0 * window * feat);
            imagined_state += alone + valued * (project + read);
            imagined_step += 2.0 * project - feat * dim + read + first;
        }
        Self {
            first_conv: conv(31.0, 3.0, depth),
            encoder_rest: conv(14.0, depth, 2.0 * depth) + 2.0 * tail,
            tail,
            decoder: decoder(feat, 4.0),
            background_decoder: decoder(float(model.background_frames) * embed, 3.0),
            // The real transitions of both branches, one hypothetical of the one and two of the other.
            observe: 5.0 * transition + (2.0 + hypothetical) * prior + 2.0 * posterior + gate,
            heads: reward + discount + mlp(inverse_feat, model.inverse_layers, action),
            imagined_state,
            imagined_step,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_needs_460_megaflop_per_frame() {
        let mut config = Config::default();
        config.model.inverse = InverseInput::EmbedDiff;
        let cost = UpdateCost::new(&config, 2);
        let per_frame = cost.world_model / config.batch_steps() as f64;
        assert!((per_frame / 460e6 - 1.0).abs() < 0.02, "{per_frame}");
    }

    #[test]
    fn work_grows_with_the_batch_alone_or_less() {
        let mut config = Config::default();
        let once = UpdateCost::new(&config, 2);
        config.learner.batch_size *= 2;
        let twice = UpdateCost::new(&config, 2);
        assert!((twice.total() / once.total() - 2.0).abs() < 1e-9);
        let steps: Vec<UpdateCost> = [15, 16, 17]
            .into_iter()
            .map(|horizon| {
                config.behavior.imagination_horizon = horizon;
                UpdateCost::new(&config, 2)
            })
            .collect();
        assert_eq!(steps[2].world_model, twice.world_model);
        let (first, second) = (
            steps[1].behavior - steps[0].behavior,
            steps[2].behavior - steps[1].behavior,
        );
        assert!(first > 0.0 && (first / second - 1.0).abs() < 1e-9);
    }
}
