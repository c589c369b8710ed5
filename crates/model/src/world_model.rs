//! The decoupled world model: networks, and the loss of representation learning (Iso-Dream++ Eq. 4-10).

use isodream_core::Config;
use isodream_core::config::{InverseInput, LossConfig, ModelConfig};
use tch::{Device, Kind, Tensor};

use crate::batch::Batch;
use crate::chunked::sum_of_parts;
use crate::decoder::{Decoder, compose};
use crate::encoder::{Embeddings, Encoder, embed_dim, stack_frames};
use crate::laps::{Laps, phase};
use crate::losses::{HALF_LOG_2PI, balanced_kl, gaussian_nll};
use crate::nn::{Mlp, to_phases};
use crate::noise::choose;
use crate::params::Scope;
use crate::reward::{RewardHead, head_feat};
use crate::rssm::{Observed, Rssm, State};
use crate::variance::variance_losses;

/// Frames that are decoded at a time: more need more memory and are no faster.
const DECODED_FRAMES: i64 = 64;

/// Every network that representation learning trains.
#[derive(Debug)]
pub struct WorldModel {
    /// Images to embeddings.
    pub encoder: Encoder,
    /// Latent dynamics.
    pub rssm: Rssm,
    /// Latents to images.
    pub decoder: Decoder,
    heads: Heads,
    config: ModelConfig,
    loss: LossConfig,
    posterior_steps: (i64, i64),
}

#[derive(Debug)]
struct Heads {
    reward: RewardHead,
    inverse: Mlp,
    discount: Option<Mlp>,
}

/// A sequence seen by the encoder and the latent dynamics.
#[derive(Debug)]
pub struct Encoded {
    /// `[B, T, 2 depth, ..]`.
    pub stem: Tensor,
    /// `[B, T, embed]` each.
    pub embed: Embeddings,
    /// Latents.
    pub observed: Observed,
}

/// Errors of the inverse dynamics, over the error of guessing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InverseErrors {
    /// With the pictures.
    pub seeing: f64,
    /// With black pictures.
    pub blind: f64,
}

/// The world-model loss, its terms, and what behaviour learning starts from.
#[derive(Debug)]
pub struct WorldModelLoss {
    /// `L_all` of Eq. 10.
    pub total: Tensor,
    /// Unweighted terms and diagnostics by metric name.
    pub terms: Vec<(&'static str, Tensor)>,
    /// Posterior states, detached, `[B, T, ..]`.
    pub states: State,
}

impl WorldModel {
    /// The world model of `config`.
    pub fn new(mut scope: Scope<'_>, config: &Config, action_dim: i64) -> Self {
        let model = &config.model;
        let side = config.env.image_size as i64;
        let feat = model.stoch + model.deter;
        let reward_feat = if model.indicator { 2 * feat } else { feat };
        let inverse_feat = match model.inverse {
            InverseInput::Posterior => 2 * model.stoch,
            InverseInput::EmbedDiff => embed_dim(model),
            InverseInput::Embed => 2 * embed_dim(model),
        };
        Self {
            encoder: Encoder::new(scope.sub("encoder"), model, side, action_dim),
            rssm: Rssm::new(scope.sub("rssm"), model, action_dim),
            decoder: Decoder::new(scope.sub("decoder"), model, side),
            heads: Heads {
                reward: RewardHead::new(scope.sub("reward"), model),
                inverse: Mlp::new(
                    scope.sub("inverse"),
                    inverse_feat,
                    model.inverse_layers,
                    model.units,
                    action_dim,
                ),
                discount: model.discount_head.then(|| {
                    Mlp::new(
                        scope.sub("discount"),
                        reward_feat,
                        model.discount_layers,
                        model.units,
                        1,
                    )
                }),
            },
            config: model.clone(),
            loss: config.loss.clone(),
            posterior_steps: config.posterior_steps(),
        }
    }

    /// What reward and discount heads see: `[s, h, z, h']` with the indicator on, else `[s, h]`.
    pub fn head_feat(&self, state: &State) -> Tensor {
        head_feat(state, self.config.indicator)
    }

    /// The expected reward at a state.
    ///
    /// # Shapes
    /// `[.., ..] -> [..]`
    pub fn reward(&self, state: &State) -> Tensor {
        self.heads.reward.forward(state)
    }

    /// The probability that the episode goes on from a state; none without a discount head.
    pub fn continuation(&self, state: &State) -> Option<Tensor> {
        let head = self.heads.discount.as_ref()?;
        Some(
            head.forward(&self.head_feat(state))
                .squeeze_dim(-1)
                .sigmoid(),
        )
    }

    /// Encodes a sequence and infers its latents.
    ///
    /// # Shapes
    /// `images: [B, T, 3, side, side]`, `actions: [B, T, A]`
    pub fn encode(&self, images: &Tensor, actions: &Tensor) -> Encoded {
        let (batch, length) = (images.size()[0], images.size()[1]);
        let seen = stack_frames(images, self.config.encoder_frames);
        let stem = self.encoder.stem.forward(&seen.flatten(0, 1));
        let flat = self.encoder.embed(&stem, &actions.flatten(0, 1));
        let unflatten = |x: &Tensor| x.unflatten(0, [batch, length]);
        let embed = Embeddings {
            controllable: unflatten(&flat.controllable),
            noncontrollable: unflatten(&flat.noncontrollable),
        };
        Encoded {
            stem: unflatten(&stem),
            observed: self.rssm.observe(actions, &embed),
            embed,
        }
    }

    /// What the decoders see: features of both branches, `[B, T, stoch + deter]`. The first posterior steps are
    /// posterior samples and the rest prior samples, as in the authors' code.
    fn decoder_feats(&self, encoded: &Encoded) -> (Tensor, Tensor) {
        let observed = &encoded.observed;
        let feat = |stoch: Tensor, deter: &Tensor| Tensor::cat(&[stoch, deter.shallow_clone()], -1);
        let (s, z) = (
            &observed.states.controllable,
            &observed.states.noncontrollable,
        );
        let s_stoch = posterior_then_prior(
            &s.stoch,
            || observed.controllable_prior.sample(),
            self.posterior_steps.0,
        );
        let z_stoch = posterior_then_prior(
            &z.stoch,
            || observed.noncontrollable_prior.sample(),
            self.posterior_steps.1,
        );
        (feat(s_stoch, &s.deter), feat(z_stoch, &z.deter))
    }

    /// `-ln p(o_t | ..)` of the reconstructed sequences (Eq. 6), with the mean masks of both dynamic branches.
    fn image_loss(&self, batch: &Batch, encoded: &Encoded) -> (Tensor, [Tensor; 2]) {
        let (s, z) = self.decoder_feats(encoded);
        let background = self.decoder.background(&encoded.stem);
        let (sequences, length) = (s.size()[0], s.size()[1]);
        // Every sequence shows as many frames, so that all have an equal part of the background's gradient.
        let shown = ((self.loss.decoded_share * length as f64).ceil() as i64).clamp(1, length);
        let frames = some_frames(sequences, length, shown, s.device());
        let some = |x: &Tensor| match &frames {
            Some(frames) => x.flatten(0, 1).index_select(0, frames),
            None => x.flatten(0, 1),
        };
        let [s, z] = self
            .decoder
            .project(&some(&s), &some(&z))
            .map(|projected| projected.unflatten(0, [sequences, shown]));
        let images = some(&batch.images).unflatten(0, [sequences, shown]);
        let mut masks = [(); 2].map(|()| Tensor::zeros([], (Kind::Float, s.device())));
        let loss = sum_of_parts(
            &[&s, &z, &background, &images],
            &self.decoder.upsampling_parameters(),
            (DECODED_FRAMES / shown).max(1),
            |part| {
                let share = part[0].size()[0] as f64 / sequences as f64;
                let [s, z] = self
                    .decoder
                    .upsample(&part[0].flatten(0, 1), &part[1].flatten(0, 1));
                for (sum, component) in masks.iter_mut().zip([&s, &z]) {
                    *sum += component.mask.detach().mean(Kind::Float) * share;
                }
                let target = to_phases(&part[3]);
                let background = part[2].unsqueeze(1).expand_as(&target);
                let composition = compose(s, z, background.flatten(0, 1));
                gaussian_nll(&composition.image, &target.flatten(0, 1), 4) * share
            },
        );
        (loss, masks)
    }

    /// `L_all = L_base + L_var` (Eq. 6, 10), the gate's sparsity penalty included.
    pub fn loss(&self, batch: &Batch, laps: &mut Laps) -> WorldModelLoss {
        let encoded = self.encode(&batch.images, &batch.actions);
        laps.lap(phase::ENCODE);
        let observed = &encoded.observed;
        let (image, masks) = self.image_loss(batch, &encoded);
        laps.lap(phase::DECODE);

        let reward_mean = self.reward(&observed.states);
        let reward = gaussian_nll(&reward_mean, &batch.rewards, 0);
        let action = self.inverse_loss(&batch.actions, &encoded);
        let controllable_kl = self.kl(
            &observed.controllable_posterior,
            &observed.controllable_prior,
        );
        let noncontrollable_kl = self.kl(
            &observed.noncontrollable_posterior,
            &observed.noncontrollable_prior,
        );

        let weights = &self.loss;
        let mut total = &image
            + &reward * weights.reward_scale
            + &action * weights.action_scale
            + &controllable_kl * weights.controllable_kl_scale
            + &noncontrollable_kl * weights.noncontrollable_kl_scale;
        let reward_error = (reward_mean - &batch.rewards).abs().mean(Kind::Float);
        let [controllable_mask, noncontrollable_mask] = masks;
        let mut terms = vec![
            ("train/loss/image", image),
            ("train/loss/reward", reward),
            ("train/loss/action", action),
            ("train/loss/controllable_kl", controllable_kl),
            ("train/loss/noncontrollable_kl", noncontrollable_kl),
            ("train/reward_error", reward_error),
            ("train/mask/controllable", controllable_mask),
            ("train/mask/noncontrollable", noncontrollable_mask),
        ];
        if weights.constrains_variance() {
            let (max_action, min_free) =
                variance_losses(&self.rssm, weights.variance, &batch.actions, observed);
            total += &max_action * weights.max_action_scale + &min_free * weights.min_free_scale;
            terms.push(("train/loss/max_action", max_action));
            terms.push(("train/loss/min_free", min_free));
        }
        if let Some(open) = &observed.gate_open {
            let gate = open.mean(Kind::Float);
            total += (&gate - weights.gate_share).clamp_min(0.0) * weights.gate_scale;
            terms.push(("train/loss/gate", gate));
        }
        if weights.open_loop_scale > 0.0 {
            let (open_loop, error) = self.open_loop_reward(batch, observed);
            total += &open_loop * weights.open_loop_scale;
            terms.push(("train/loss/open_loop", open_loop));
            terms.push(("train/open_loop_error", error));
        }
        if let Some(head) = &self.heads.discount {
            let logits = head
                .forward(&self.head_feat(&observed.states))
                .squeeze_dim(-1);
            let discount = logits.binary_cross_entropy_with_logits::<&Tensor>(
                &batch.discounts,
                None,
                None,
                tch::Reduction::Mean,
            );
            total += &discount * weights.discount_scale;
            terms.push(("train/loss/discount", discount));
        }
        terms.push(("train/loss/model", total.shallow_clone()));
        laps.lap(phase::LOSSES);
        WorldModelLoss {
            total,
            terms,
            states: observed.states.map(Tensor::detach),
        }
    }

    /// The reward log loss of states that are predicted from the actions alone, once a quarter of each sequence is seen:
    /// what the returns of imagination are made of. With the mean absolute error.
    fn open_loop_reward(&self, batch: &Batch, observed: &Observed) -> (Tensor, Tensor) {
        let length = batch.actions.size()[1];
        let seen = open_loop_start(length);
        let start = observed.states.map(|x| x.select(1, seen - 1));
        let later = |x: &Tensor| x.narrow(1, seen, length - seen);
        let rewards = self.reward(&self.rssm.imagine(&start, &later(&batch.actions)));
        let target = later(&batch.rewards);
        let error = (&rewards - &target).abs().mean(Kind::Float);
        (gaussian_nll(&rewards, &target, 0), error)
    }

    fn kl(&self, posterior: &crate::rssm::Gaussian, prior: &crate::rssm::Gaussian) -> Tensor {
        balanced_kl(posterior, prior, self.loss.kl_balance, self.loss.free_nats)
    }

    /// Inverse dynamics (Eq. 4): the action between neighbouring states, `0.5 |a - a_hat|^2` plus the constant
    /// of a unit Gaussian.
    fn inverse_loss(&self, actions: &Tensor, encoded: &Encoded) -> Tensor {
        let neighbours = |x: &Tensor| {
            let steps = x.size()[1] - 1;
            Tensor::cat(&[x.narrow(1, 0, steps), x.narrow(1, 1, steps)], -1)
        };
        let embed = &encoded.embed.controllable;
        let input = match self.config.inverse {
            InverseInput::Posterior => neighbours(&encoded.observed.states.controllable.stoch),
            InverseInput::EmbedDiff => embed.diff::<&Tensor>(1, 1, None, None),
            InverseInput::Embed => neighbours(embed),
        };
        let steps = input.size()[1];
        gaussian_nll(
            &self.heads.inverse.forward(&input),
            &actions.narrow(1, 1, steps),
            1,
        )
    }

    /// What the inverse dynamics gains from pictures: its squared error over that of guessing the mean action of the
    /// batch, with the true pictures and with black ones. Where the second is much below 1, it reads the action
    /// elsewhere.
    pub fn inverse_errors(&self, batch: &Batch) -> InverseErrors {
        let _guard = tch::no_grad_guard();
        let actions = &batch.actions;
        let constant = HALF_LOG_2PI * actions.size()[2] as f64;
        let later = actions.narrow(1, 1, actions.size()[1] - 1);
        let mean = later.mean_dim([0_i64, 1].as_slice(), true, Kind::Float);
        let guessed = (gaussian_nll(&mean.expand_as(&later), &later, 1) - constant).clamp_min(1e-8);
        let of = |images: &Tensor| {
            let loss = self.inverse_loss(actions, &self.encode(images, actions)) - constant;
            (loss / &guessed).double_value(&[])
        };
        InverseErrors {
            seeing: of(&batch.images),
            blind: of(&batch.images.full_like(-0.5)),
        }
    }
}

/// Steps of a sequence that are seen before the rest of it is predicted in open loop.
pub(crate) fn open_loop_start(length: i64) -> i64 {
    (length / 4).max(1)
}

/// Rows of `[sequences length, ..]` that are `shown` different frames of each sequence, drawn at random; none where all
/// are shown.
fn some_frames(sequences: i64, length: i64, shown: i64, device: Device) -> Option<Tensor> {
    (shown < length).then(|| {
        let rows: Vec<Tensor> = (0..sequences)
            .map(|sequence| choose(length, shown, device) + sequence * length)
            .collect();
        Tensor::cat(&rows, 0)
    })
}

/// The first `steps` of `posterior` along time, then prior samples.
fn posterior_then_prior(posterior: &Tensor, prior: impl FnOnce() -> Tensor, steps: i64) -> Tensor {
    let length = posterior.size()[1];
    if steps >= length {
        return posterior.shallow_clone();
    }
    let rest = prior().narrow(1, steps, length - steps);
    Tensor::cat(&[posterior.narrow(1, 0, steps), rest], 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::Params;
    use isodream_core::config::Source;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    /// Steps along axis 1 where `x: [B, T, ..]` is not zero.
    fn nonzero_steps(x: &Tensor) -> Vec<i64> {
        (0..x.size()[1])
            .filter(|&t| x.select(1, t).abs().sum(Kind::Float).double_value(&[]) > 0.0)
            .collect()
    }

    #[test]
    fn posterior_samples_come_first() {
        let posterior = Tensor::zeros([2, 5, 3], FLOAT);
        let joined = posterior_then_prior(&posterior, || Tensor::ones([2, 5, 3], FLOAT), 2);
        assert_eq!(joined.size(), [2, 5, 3]);
        assert_eq!(nonzero_steps(&joined), [2, 3, 4]);
    }

    /// A small world model of two actions.
    fn world(params: &mut Params) -> WorldModel {
        let config = Config::load(&Source {
            preset: Some("debug".into()),
            ..Source::default()
        })
        .expect("a valid preset");
        WorldModel::new(params.root("world_model"), &config, 2)
    }

    #[test]
    fn the_open_loop_loss_sees_a_quarter_of_the_pictures_and_all_actions() {
        let mut params = Params::new(Device::Cpu);
        let world = world(&mut params);
        let images = Tensor::rand([2, 8, 3, 64, 64], FLOAT).set_requires_grad(true);
        let actions = Tensor::rand([2, 8, 2], FLOAT).set_requires_grad(true);
        let encoded = world.encode(&images, &actions);
        let batch = Batch {
            images: images.shallow_clone(),
            actions: actions.shallow_clone(),
            rewards: Tensor::zeros([2, 8], FLOAT),
            discounts: Tensor::ones([2, 8], FLOAT),
        };
        let (loss, error) = world.open_loop_reward(&batch, &encoded.observed);
        let by = Tensor::run_backward(&[&loss], &[&images, &actions], false, false);
        assert_eq!(nonzero_steps(&by[0]), [0, 1]);
        assert_eq!(nonzero_steps(&by[1]), [0, 1, 2, 3, 4, 5, 6, 7]);
        // Rewards are zero: the error is the mean of what is predicted.
        let squared = (loss.double_value(&[]) - HALF_LOG_2PI) * 2.0;
        assert!(squared > 0.0 && error.double_value(&[]).powi(2) <= squared);
    }

    #[test]
    fn inverse_dynamics_predicts_the_action_between_two_states() {
        let mut params = Params::new(Device::Cpu);
        let world = world(&mut params);
        let images = Tensor::rand([2, 6, 3, 64, 64], FLOAT) - 0.5;
        let actions = Tensor::rand([2, 6, 2], FLOAT);
        let encoded = world.encode(&images, &actions);
        let actions = actions.set_requires_grad(true);
        let loss = world.inverse_loss(&actions, &encoded);
        let by_action = Tensor::run_backward(&[loss], &[&actions], true, true);
        // The first action led to the first state, and nothing is known before that.
        assert_eq!(nonzero_steps(&by_action[0]), [1, 2, 3, 4, 5]);
        let third = by_action[0].select(1, 3).sum(Kind::Float);
        let stoch = &encoded.observed.states.controllable.stoch;
        let seen = Tensor::run_backward(&[third], &[stoch], false, false);
        assert_eq!(nonzero_steps(&seen[0]), [2, 3]);
    }
}
