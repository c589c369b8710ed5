//! Adam with clipping by global norm, over a group's flat vector.

use isodream_core::config::OptimizerConfig;
use tch::Tensor;

use crate::params::Params;

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;

/// Parameters that are moved at a time: their moments, gradients and intermediate results fit the cache.
const SLICE: i64 = 1 << 18;

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
    /// Returns the gradient's global norm before clipping. The graph is freed.
    pub fn minimize(&mut self, loss: &Tensor, params: &Params) -> Tensor {
        let gradients = Tensor::run_backward(&[loss], &params.tensors(), false, false);
        self.step(params, &gradients)
    }

    /// One step along `gradients`, one per parameter in their order; what no gradient reached counts as zero.
    ///
    /// Every slice goes through all operations while it is in the processor's cache, and nothing as long as the
    /// parameters is allocated.
    pub fn step(&mut self, params: &Params, gradients: &[Tensor]) -> Tensor {
        let _guard = tch::no_grad_guard();
        let norms: Vec<Tensor> = gradients
            .iter()
            .filter(|gradient| gradient.defined())
            .map(Tensor::norm)
            .collect();
        let norm = Tensor::stack(&norms, 0).norm();
        // As torch.nn.utils.clip_grad_norm_: scale = min(1, clip / (norm + 1e-6)), without reading the norm.
        let scale = ((&norm + 1e-6).reciprocal() * self.grad_clip).clamp_max(1.0);
        self.steps += 1;
        let mut offset = 0;
        for (parameter, gradient) in params.tensors().into_iter().zip(gradients) {
            let count = parameter.numel() as i64;
            let flat = gradient.defined().then(|| gradient.reshape([count]));
            let mut first = 0;
            while first < count {
                let len = SLICE.min(count - first);
                let gradient = match &flat {
                    Some(flat) => flat.narrow(0, first, len) * &scale,
                    None => scale.zeros_like().expand([len], false),
                };
                self.step_slice(params, offset + first, &gradient);
                first += len;
            }
            offset += count;
        }
        norm
    }

    /// The step of the parameters from `offset` on, along a clipped gradient `[len]`.
    fn step_slice(&mut self, params: &Params, offset: i64, gradient: &Tensor) {
        let slice = |flat: &Tensor| flat.narrow(0, offset, gradient.size()[0]);
        let (mut first, mut second) = (slice(&self.first), slice(&self.second));
        let _ = first.lerp_(gradient, 1.0 - BETA1);
        let _ = second.g_mul_scalar_(BETA2);
        let _ = second.addcmul_(&(gradient * (1.0 - BETA2)), gradient);
        let steps = self.steps as i32;
        let step_size = self.lr / (1.0 - BETA1.powi(steps));
        let denominator = second.sqrt() / (1.0 - BETA2.powi(steps)).sqrt() + self.eps;
        let _ = slice(params.flat()).addcdiv_(&(first * -step_size), &denominator);
    }
}
