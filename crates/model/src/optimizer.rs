//! Adam with clipping by global norm, over a group's flat vector.

use isodream_core::config::OptimizerConfig;
use tch::Tensor;

use crate::params::Params;

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;

/// Adam's state for one group of parameters.
#[derive(Debug)]
pub struct Adam {
    lr: f64,
    eps: f64,
    grad_clip: f64,
    /// First moment, flat like the parameters.
    pub first: Tensor,
    /// Second moment, flat like the parameters.
    pub second: Tensor,
    /// Steps made.
    pub steps: u64,
}

impl Adam {
    /// A fresh optimiser for `params`, which must be flattened.
    pub fn new(params: &Params, lr: f64, config: &OptimizerConfig) -> Self {
        Self {
            lr,
            eps: config.eps,
            grad_clip: config.grad_clip,
            first: params.flat().zeros_like(),
            second: params.flat().zeros_like(),
            steps: 0,
        }
    }

    /// Descends the gradient of `loss` with respect to `params`, and to nothing else the loss may depend on.
    /// Returns the gradient's global norm before clipping. The graph is freed unless it is to be kept for
    /// another loss.
    pub fn minimize(&mut self, loss: &Tensor, params: &Params, keep_graph: bool) -> Tensor {
        let inputs = params.tensors();
        let grads = Tensor::run_backward(&[loss], &inputs, keep_graph, false);
        let _guard = tch::no_grad_guard();
        let flat: Vec<Tensor> = grads
            .iter()
            .zip(&inputs)
            .map(|(grad, input)| {
                if grad.defined() {
                    grad.flatten(0, -1)
                } else {
                    input.zeros_like().flatten(0, -1)
                }
            })
            .collect();
        self.step(params, Tensor::cat(&flat, 0))
    }

    /// One step along `grad`, `[numel]`.
    pub fn step(&mut self, params: &Params, mut grad: Tensor) -> Tensor {
        let _guard = tch::no_grad_guard();
        let norm = grad.norm();
        // As torch.nn.utils.clip_grad_norm_: scale = min(1, clip / (norm + 1e-6)), without reading the norm.
        let _ = grad.g_mul_(&((&norm + 1e-6).reciprocal() * self.grad_clip).clamp_max(1.0));
        self.steps += 1;
        let _ = self.first.lerp_(&grad, 1.0 - BETA1);
        let _ = self.second.g_mul_scalar_(BETA2);
        let _ = self.second.addcmul_(&(&grad * (1.0 - BETA2)), &grad);
        let steps = self.steps as i32;
        let step_size = self.lr / (1.0 - BETA1.powi(steps));
        let denominator = self.second.sqrt() / (1.0 - BETA2.powi(steps)).sqrt() + self.eps;
        let mut flat = params.flat().shallow_clone();
        let _ = flat.addcdiv_(&(&self.first * -step_size), &denominator);
        norm
    }
}
