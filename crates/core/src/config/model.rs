//! `[model]` and `[loss]`

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What the inverse dynamics (Eq. 4) sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq, JsonSchema, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum InverseInput {
    /// The posterior samples `s_{t-1}`, `s_t`, as in the paper. Their recurrent state has heard the action, so that the
    /// loss can be low without a look at the picture (`train/inverse_blind`).
    Posterior,
    /// The difference of the controllable embeddings, as in the authors' code. With `encoder_actions` the
    /// embedding already contains the target, a leak that the authors' code has as well.
    EmbedDiff,
    /// The controllable embeddings of two neighbouring frames, side by side. They see nothing but pictures: needs
    /// `encoder_actions = false`.
    Embed,
}

/// How the min-max variance constraints (Eq. 8, 9) are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, JsonSchema, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VarianceLoss {
    /// The authors' code: mean |cos| of the controllable `deter` under opposite actions; sum of squared
    /// differences of the noncontrollable `deter`. Bounded, and what produced the published numbers.
    Deter,
    /// The paper's text: the sample variance of prior samples, maximised and minimised.
    Paper,
}

/// Which branches a picture is made of. All but the first are for comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq, JsonSchema, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Branches {
    /// Controllable, noncontrollable and static: Iso-Dream++ (Eq. 5).
    All,
    /// Without the static one: `M^s o^s + (1 - M^s) o^z`.
    Dynamic,
    /// The controllable one alone: a Dreamer with Gaussian latents. Needs `indicator = false`; the weights of the losses
    /// that concern the other branches are best set to 0.
    Controllable,
}

/// How the rollout of noncontrollable states enters the policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, JsonSchema, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FutureStates {
    /// By attention (Eq. 13).
    Attention,
    /// All of them beside the controllable state, as in the paper's ablation.
    Concatenation,
}

/// Sizes and options of the networks.
#[derive(Debug, Clone, PartialEq, JsonSchema, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ModelConfig {
    /// Channels of the first convolution; the others are multiples.
    pub cnn_depth: i64,
    /// Width of a branch's recurrent state (`h`, `h'`).
    pub deter: i64,
    /// Width of a branch's Gaussian latent (`s`, `z`).
    pub stoch: i64,
    /// Width of the layers inside a branch.
    pub hidden: i64,
    /// Least standard deviation of a latent.
    pub min_std: f64,
    /// Width of the heads' hidden layers.
    pub units: i64,
    /// Hidden layers of the reward head.
    pub reward_layers: i64,
    /// Hidden layers of the inverse dynamics (the paper's 2-layer MLP).
    pub inverse_layers: i64,
    /// Hidden layers of the discount head.
    pub discount_layers: i64,
    /// Hidden layers of the actor.
    pub actor_layers: i64,
    /// Least standard deviation of the policy: 0.1 in DreamerV2 and the authors' code. 0.2 sees over a valley of the
    /// return that 0.1 does not.
    pub policy_min_std: f64,
    /// Hidden layers of the critic.
    pub critic_layers: i64,
    /// Width of the projections in the future-state attention.
    pub attention_dim: i64,
    /// Frames that the static branch sees (K).
    pub background_frames: i64,
    /// The paper's indicator: whether noncontrollable states enter reward and policy (driving), or are
    /// ignored as noise (video backgrounds).
    pub indicator: bool,
    /// Which branches a picture is made of.
    pub branches: Branches,
    /// How the rollout of noncontrollable states enters the policy.
    pub future: FutureStates,
    /// Whether the dependency gate lets controllable states into the noncontrollable transition (Eq. 11, 12).
    pub dependency_gate: bool,
    /// Initial bias of the gate's logit: above 0 the gate begins open. 0 keeps PyTorch's random initialisation, as in the
    /// authors' code.
    pub gate_bias: f64,
    /// Pictures that the encoder sees at once: the newest, and those right before it (frame stacking). With 1, as in the
    /// paper, only the recurrent states know how fast anything moves.
    pub encoder_frames: i64,
    /// Whether the branch encoders see the previous action.
    pub encoder_actions: bool,
    /// What the inverse dynamics sees.
    pub inverse: InverseInput,
    /// Initial bias of the mask logits. 0 keeps PyTorch's random initialisation, as in the authors' code: each
    /// dynamic branch begins with about half of every pixel and the static one with nothing. Below 0, the
    /// dynamic branches begin with little and claim what they need.
    pub mask_bias: f64,
    /// Whether the end of an episode is predicted (`ln p(gamma_t)` of Eq. 6; off in the published setups).
    pub discount_head: bool,
}

impl Default for ModelConfig {
    fn default() -> Self {
        Self {
            cnn_depth: 32,
            deter: 200,
            stoch: 50,
            hidden: 200,
            min_std: 0.1,
            units: 400,
            reward_layers: 2,
            inverse_layers: 2,
            discount_layers: 3,
            actor_layers: 4,
            policy_min_std: 0.1,
            critic_layers: 3,
            attention_dim: 500,
            background_frames: 10,
            indicator: true,
            branches: Branches::All,
            future: FutureStates::Attention,
            dependency_gate: true,
            gate_bias: 0.0,
            encoder_frames: 1,
            encoder_actions: true,
            inverse: InverseInput::Posterior,
            mask_bias: 0.0,
            discount_head: false,
        }
    }
}

/// Weights and options of the world-model losses (Eq. 6, 8-10).
#[derive(Debug, Clone, PartialEq, JsonSchema, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LossConfig {
    /// Weight of the reward log loss: 2 in the authors' code, 1 in the paper.
    pub reward_scale: f64,
    /// `alpha` of Eq. 6: weight of the action loss.
    pub action_scale: f64,
    /// Weight of the discount log loss.
    pub discount_scale: f64,
    /// `beta_1` of Eq. 6: weight of the controllable branch's KL.
    pub controllable_kl_scale: f64,
    /// `beta_2` of Eq. 6: weight of the noncontrollable branch's KL.
    pub noncontrollable_kl_scale: f64,
    /// Share of the KL that trains the prior (DreamerV2).
    pub kl_balance: f64,
    /// Nats below which a branch's mean KL is not reduced.
    pub free_nats: f64,
    /// How the variance constraints are measured.
    pub variance: VarianceLoss,
    /// `lambda_1` of Eq. 10: weight of the controllable branch's constraint (`max_action_loss`).
    pub max_action_scale: f64,
    /// `lambda_2` of Eq. 10: weight of the noncontrollable branch's constraint (`min_free_loss`).
    pub min_free_scale: f64,
    /// Weight of the mean gate opening, the authors' sparsity penalty.
    pub gate_scale: f64,
    /// Share of the steps in which the gate may be open without a penalty; with the authors' 0 every opening costs.
    pub gate_share: f64,
    /// Share of a sequence that the controllable branch reconstructs from posterior samples; the rest from
    /// prior samples. 0.5 for driving, 1 for DeepMind Control.
    pub controllable_posterior_share: f64,
    /// The same share for the noncontrollable branch: 1 for driving, 0.8 for DeepMind Control.
    pub noncontrollable_posterior_share: f64,
    /// Share of a batch's frames that are decoded, in (0, 1]: drawn at random, so that the image loss stays unbiased.
    /// Decoding is most of an update's work.
    pub decoded_share: f64,
    /// Weight of the reward log loss in open loop: of states that are predicted from the actions alone, once a quarter
    /// of each sequence is seen. It trains what imagination uses, and costs one rollout more; 0 in the paper.
    pub open_loop_scale: f64,
}

impl LossConfig {
    /// Whether either variance constraint has a weight; they are not computed else.
    pub fn constrains_variance(&self) -> bool {
        self.max_action_scale != 0.0 || self.min_free_scale != 0.0
    }
}

impl Default for LossConfig {
    fn default() -> Self {
        Self {
            reward_scale: 2.0,
            action_scale: 1.0,
            discount_scale: 1.0,
            controllable_kl_scale: 1.0,
            noncontrollable_kl_scale: 1.0,
            kl_balance: 0.8,
            free_nats: 1.0,
            variance: VarianceLoss::Deter,
            max_action_scale: 1.0,
            min_free_scale: 1.0,
            gate_scale: 1.0,
            gate_share: 0.0,
            controllable_posterior_share: 0.5,
            noncontrollable_posterior_share: 1.0,
            decoded_share: 1.0,
            open_loop_scale: 0.0,
        }
    }
}
