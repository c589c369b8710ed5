//! The reward head, and imagined returns of given actions.

use isodream_core::Config;
use isodream_core::config::ModelConfig;
use safetensors::SafeTensors;
use tch::{Device, Kind, Tensor};

use crate::nn::Mlp;
use crate::params::{LoadError, Params, Scope};
use crate::rssm::{Rssm, State};

/// Names of the reward head's parameters begin with it.
const SCOPE: [&str; 2] = ["world_model", "reward"];

/// Starts of one imagination at most, samples counted: more need more memory and are no faster.
const ROWS: i64 = 1_024;

/// The expected reward at a state.
#[derive(Debug)]
pub struct RewardHead {
    mlp: Mlp,
    indicator: bool,
}

impl RewardHead {
    /// The head of `config`.
    pub fn new(scope: Scope<'_>, config: &ModelConfig) -> Self {
        let branches = if config.indicator { 2 } else { 1 };
        let inputs = branches * (config.stoch + config.deter);
        Self {
            mlp: Mlp::new(scope, inputs, config.reward_layers, config.units, 1),
            indicator: config.indicator,
        }
    }

    /// # Shapes
    /// `[.., ..] -> [..]`
    pub fn forward(&self, state: &State) -> Tensor {
        let feat = head_feat(state, self.indicator);
        self.mlp.forward(&feat).squeeze_dim(-1)
    }
}

/// What reward and discount heads see: `[s, h, z, h']` with the indicator on, else `[s, h]`.
pub(crate) fn head_feat(state: &State, indicator: bool) -> Tensor {
    if indicator {
        state.joint_feat()
    } else {
        state.controllable.feat()
    }
}

/// A reward head with parameters of its own, for those who imagine beside the learner.
#[derive(Debug)]
pub struct RewardModel {
    params: Params,
    head: RewardHead,
}

impl RewardModel {
    /// The reward model in published weights, or those of a checkpoint.
    ///
    /// # Errors
    /// [`LoadError`] where the bytes are damaged, of another model, or hold no reward head.
    pub fn new(config: &Config, weights: &[u8]) -> Result<Self, LoadError> {
        let mut params = Params::new(Device::Cpu);
        let head = RewardHead::new(params.root(SCOPE[0]).sub(SCOPE[1]), &config.model);
        params.flatten();
        let mut model = Self { params, head };
        model.load(weights)?;
        Ok(model)
    }

    /// Takes newer weights.
    ///
    /// # Errors
    /// As [`Self::new`]; the old weights stay then.
    pub fn load(&mut self, weights: &[u8]) -> Result<(), LoadError> {
        self.params.load(&SafeTensors::deserialize(weights)?)
    }

    /// The head itself.
    pub fn head(&self) -> &RewardHead {
        &self.head
    }

    /// Whether a parameter of this name belongs to the reward head.
    pub(crate) fn holds(name: &str) -> bool {
        let mut words = name.split('.');
        SCOPE.iter().all(|word| words.next() == Some(word))
    }
}

/// Actions to imagine from some states.
#[derive(Debug)]
pub struct Plans {
    /// Where each plan starts, `[N, ..]`.
    pub starts: State,
    /// `[N, K, A]`.
    pub actions: Tensor,
    /// 1 where the reward that a step leads to counts, else 0: `[N, K]`.
    pub counted: Tensor,
}

/// Undiscounted sums of the reward means at the `K` states that follow, averaged over `samples` imagined futures.
///
/// # Shapes
/// `-> [N]`
pub fn imagined_returns(rssm: &Rssm, reward: &RewardHead, plans: &Plans, samples: i64) -> Tensor {
    let _guard = tch::no_grad_guard();
    let count = plans.actions.size()[0];
    let part = (ROWS / samples).max(1);
    let parts: Vec<Tensor> = (0..count)
        .step_by(part as usize)
        .map(|first| {
            let rows = |x: &Tensor| {
                let some = x.narrow(0, first, part.min(count - first));
                some.repeat_interleave_self_int(samples, 0, None)
            };
            let states = rssm.imagine(&plans.starts.map(rows), &rows(&plans.actions));
            let rewards = reward.forward(&states) * rows(&plans.counted);
            rewards
                .sum_dim_intlist([1_i64].as_slice(), false, Kind::Float)
                .view([-1, samples])
                .mean_dim([1_i64].as_slice(), false, Kind::Float)
        })
        .collect();
    Tensor::cat(&parts, 0)
}
