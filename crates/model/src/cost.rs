//! The work of one training step, counted from shapes: floating-point operations of its matrix products and
//! convolutions, with nothing computed twice and nothing that nobody uses.
//!
//! A multiplication with an addition counts as 2. A layer whose weights and input both need gradients costs
//! three times its forward pass, one that passes gradients on without learning twice, one without gradients once.

use isodream_core::Config;
use isodream_core::config::{InverseInput, VarianceLoss};

use crate::encoder::embed_dim;
use crate::laps::phase;
use crate::policy::{attends, feat_width, looks_ahead};
use crate::world_model::open_loop_start;

/// Floating-point operations of one update, by [`phase`].
#[derive(Debug, Clone, PartialEq)]
pub struct UpdateCost {
    phases: Vec<(&'static str, f64)>,
}

impl UpdateCost {
    /// Of an update of `config`, for environments with `action_dim` actions.
    pub fn new(config: &Config, action_dim: usize) -> Self {
        let learner = &config.learner;
        let frames = (learner.batch_size * learner.batch_length) as f64;
        let macs = Macs::new(config, action_dim as f64);
        let length = learner.batch_length as f64;
        let background_share = (config.model.background_frames as f64 / length).min(1.0);
        // Once per sequence, on some of its frames.
        let background = macs.background_decoder / length + macs.tail * background_share;
        let predicted = if config.loss.open_loop_scale > 0.0 {
            1.0 - open_loop_start(learner.batch_length as i64) as f64 / length
        } else {
            0.0
        };
        let (encode, losses) = (
            macs.encoder_rest + macs.observe,
            macs.hypothetical + macs.heads + predicted * macs.open_loop,
        );
        // Only some frames are decoded.
        let shown = (config.loss.decoded_share * length)
            .ceil()
            .clamp(1.0, length)
            / length;
        let projected = 2.0 * shown * macs.projection;
        let starts = (frames * config.behavior.start_share).ceil().max(1.0);
        let states = config.behavior.imagination_horizon as f64;
        let steps = states - 1.0;
        let (state, step) = (&macs.imagined_state, &macs.imagined_step);
        let behavior = |part: fn(&BehaviorMacs) -> f64| {
            starts * 2.0 * (states * part(state) + steps * part(step))
        };
        let world = |macs: f64| frames * 2.0 * macs;
        Self {
            phases: vec![
                (phase::ENCODE, world(macs.first_conv + encode)),
                (
                    phase::DECODE,
                    world(background + projected + 6.0 * shown * macs.upsampling),
                ),
                (phase::LOSSES, world(losses)),
                // The first convolution's input is the image, which needs no gradient.
                (
                    phase::WORLD_MODEL_BACKWARD,
                    world(macs.first_conv + 2.0 * (encode + background + projected + losses)),
                ),
                (phase::IMAGINE, behavior(|macs| macs.imagine)),
                (phase::VALUES, behavior(|macs| macs.values)),
                (phase::ACTOR_BACKWARD, behavior(|macs| macs.actor_backward)),
                (
                    phase::CRITIC_BACKWARD,
                    behavior(|macs| macs.critic_backward),
                ),
            ],
        }
    }

    /// Of one phase; 0 where there is none of this name.
    pub fn of(&self, phase: &str) -> f64 {
        let known = self.phases.iter().find(|(name, _)| *name == phase);
        known.map_or(0.0, |(_, flops)| *flops)
    }

    /// Of all phases.
    pub fn total(&self) -> f64 {
        self.phases.iter().map(|(_, flops)| flops).sum()
    }
}

/// Multiply-accumulates of behaviour learning for one imagined state, or one step between two of them.
#[derive(Default)]
struct BehaviorMacs {
    imagine: f64,
    values: f64,
    actor_backward: f64,
    critic_backward: f64,
}

/// Multiply-accumulates: forward passes per frame for the world model; all passes for behaviour learning.
struct Macs {
    first_conv: f64,
    encoder_rest: f64,
    tail: f64,
    /// One decoder's layers before the upsampling ones, and those.
    projection: f64,
    upsampling: f64,
    background_decoder: f64,
    observe: f64,
    hypothetical: f64,
    heads: f64,
    /// A step of both branches without an observation, and its reward.
    open_loop: f64,
    imagined_state: BehaviorMacs,
    imagined_step: BehaviorMacs,
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
        let projection =
            |inputs: f64| inputs * 32.0 * depth + fold(1.0, 5.0, 32.0 * depth, 4.0 * depth);
        let small = config.env.image_size == 32;
        let upsampling = |channels: f64| {
            if small {
                return fold(5.0, 6.0, 4.0 * depth, depth) + fold(14.0, 6.0, depth, channels);
            }
            fold(5.0, 5.0, 4.0 * depth, 2.0 * depth)
                + fold(13.0, 6.0, 2.0 * depth, depth)
                + fold(30.0, 6.0, depth, channels)
        };
        let seen = 3.0 * float(model.encoder_frames);
        let (first_conv, second_conv) = if small {
            (conv(15.0, seen, 2.0 * depth), 0.0)
        } else {
            (conv(31.0, seen, depth), conv(14.0, depth, 2.0 * depth))
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
            InverseInput::Embed => 2.0 * embed,
        };
        let discount = if model.discount_head {
            mlp(head_feat, model.discount_layers, 1.0)
        } else {
            0.0
        };

        // The paper's form of the variance constraints compares samples, the authors' recurrent states.
        let hypothetical_priors = match config.loss.variance {
            VarianceLoss::Paper => 3.0,
            VarianceLoss::Deter => 0.0,
        };
        // One hypothetical transition of the one branch and two of the other.
        let hypothetical = if config.loss.constrains_variance() {
            3.0 * transition + hypothetical_priors * prior
        } else {
            0.0
        };

        let noncontrollable = if model.indicator {
            transition + prior + gate
        } else {
            0.0
        };
        let dynamics = transition + prior + noncontrollable;
        let seen = float(feat_width(config));
        let actor = mlp(seen, model.actor_layers, 2.0 * action);
        let value = mlp(seen, model.critic_layers, 1.0);
        // Where the value's gradient does not reach the actor, the slow critic has no backward pass.
        let valued = f64::from(u8::from(config.behavior.value_gradient));
        // Dynamics, reward and slow critic pass gradients to the actor without learning.
        let mut imagined_state = BehaviorMacs {
            imagine: reward + discount,
            values: value,
            actor_backward: reward + discount + valued * value,
            critic_backward: 0.0,
        };
        // Actor and critic learn; the gradient of neither goes on from their first layers, unless the critic's
        // reaches the attention.
        let first = seen * units;
        let mut imagined_step = BehaviorMacs {
            imagine: dynamics + actor,
            values: value,
            actor_backward: dynamics + 2.0 * actor - first,
            critic_backward: 2.0 * value - first,
        };
        if looks_ahead(config) {
            let window = float(config.behavior.rollout_window);
            // The first transition of the window is the imagined step's own.
            let alone =
                (window - 1.0) * prior + (window - 2.0).max(0.0) * (transition + stoch * stoch);
            imagined_state.imagine += alone;
        }
        if attends(config) {
            let window = float(config.behavior.rollout_window);
            let dim = float(model.attention_dim);
            // Four projections per query, scores and their mean. The critic's gradient reaches the weights and
            // passes all but the first projection.
            let (project, read) = (4.0 * feat * dim, 2.0 * window * feat);
            imagined_state.imagine += project + read;
            imagined_state.actor_backward += valued * (project + read);
            imagined_step.critic_backward += 2.0 * project - feat * dim + read + first;
        }
        Self {
            first_conv,
            encoder_rest: second_conv + 2.0 * tail,
            tail,
            projection: projection(feat),
            upsampling: upsampling(4.0),
            background_decoder: projection(float(model.background_frames) * embed)
                + upsampling(3.0),
            observe: 2.0 * (transition + prior + posterior) + gate,
            hypothetical,
            heads: reward + discount + mlp(inverse_feat, model.inverse_layers, action),
            open_loop: 2.0 * (transition + prior) + gate + reward,
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
        let world_model: f64 = [
            phase::ENCODE,
            phase::DECODE,
            phase::LOSSES,
            phase::WORLD_MODEL_BACKWARD,
        ]
        .into_iter()
        .map(|phase| cost.of(phase))
        .sum();
        let per_frame = world_model / config.batch_steps() as f64;
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
        assert_eq!(steps[2].of(phase::DECODE), twice.of(phase::DECODE));
        assert!(twice.of(phase::DECODE) > 0.0);
        let (first, second) = (
            steps[1].total() - steps[0].total(),
            steps[2].total() - steps[1].total(),
        );
        assert!(first > 0.0 && (first / second - 1.0).abs() < 1e-9);
    }
}
