//! The dependency gate between the branches (Iso-Dream++ Eq. 11, 12).

use isodream_core::config::ModelConfig;
use tch::{Kind, Tensor};

use crate::nn::Linear;
use crate::params::Scope;

/// Decides whether the controllable state enters the next noncontrollable one, and merges them.
///
/// The gate reads the recurrent states and its opening is penalised, as in the authors' code; the paper's
/// text gives it the stochastic states and no penalty.
#[derive(Debug)]
pub struct DependencyGate {
    /// `f` of Eq. 11: `[1, 2 deter]`.
    pub gate: Linear,
    /// The merge `[z, w s] -> z_in`: `[stoch, 2 stoch]`.
    pub merge: Linear,
}

impl DependencyGate {
    /// The gate of `config`.
    pub fn new(mut scope: Scope<'_>, config: &ModelConfig) -> Self {
        let gate = Self {
            gate: Linear::new(scope.sub("gate"), 2 * config.deter, 1),
            merge: Linear::new(scope.sub("merge"), 2 * config.stoch, config.stoch),
        };
        if config.gate_bias != 0.0 {
            let _ = tch::no_grad(|| gate.gate.bias.shallow_clone().fill_(config.gate_bias));
        }
        gate
    }

    /// `w_t` of Eq. 11: 1 where `sigmoid(f(h', h)) >= 0.5`, else 0. The gradient passes straight through
    /// the threshold: `dw = d sigmoid(f)`.
    ///
    /// # Shapes
    /// `[N, deter]` twice `-> [N, 1]`
    pub fn open(&self, noncontrollable_deter: &Tensor, controllable_deter: &Tensor) -> Tensor {
        let soft = self
            .logit(noncontrollable_deter, controllable_deter)
            .sigmoid();
        let hard = soft.ge(0.5).to_kind(Kind::Float);
        (hard - &soft).detach() + soft
    }

    /// `f(h', h)` of Eq. 11: above 0 where the gate is open.
    ///
    /// # Shapes
    /// `[.., deter]` twice `-> [.., 1]`
    pub fn logit(&self, noncontrollable_deter: &Tensor, controllable_deter: &Tensor) -> Tensor {
        let deters = Tensor::cat(&[noncontrollable_deter, controllable_deter], -1);
        // In full precision: a threshold follows.
        self.gate.forward_in(Kind::Float, &deters)
    }

    /// The state that replaces `z_t` in the transition of Eq. 12: `Linear([z, w s])`.
    ///
    /// # Shapes
    /// `[N, stoch]` twice, `open: [N, 1]` `-> [N, stoch]`
    pub fn merge(&self, noncontrollable: &Tensor, controllable: &Tensor, open: &Tensor) -> Tensor {
        self.merge
            .forward(&Tensor::cat(&[noncontrollable, &(open * controllable)], -1))
    }

    /// [`Self::merge`] with the gate shut: the input of a step that the noncontrollable branch makes alone.
    /// The authors' code leaves the merge out there, so that training and rollouts see different inputs;
    /// here both see the same.
    pub fn merge_shut(&self, noncontrollable: &Tensor) -> Tensor {
        let shut = noncontrollable.zeros_like();
        self.merge
            .forward(&Tensor::cat(&[noncontrollable, &shut], -1))
    }
}
