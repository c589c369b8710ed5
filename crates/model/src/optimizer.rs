//! Adam with clipping by global norm, over a group's flat vector.

use isodream_core::config::OptimizerConfig;
use tch::{Device, Tensor};

use crate::params::Params;

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;

/// Adam's state for one group of parameters.
#[derive(Debug)]
pub struct Adam {
    lr: f64,
    /// What the learning rate is multiplied by.
    pub lr_factor: f64,
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
            lr_factor: 1.0,
            eps: config.eps,
            grad_clip: config.grad_clip,
            first: params.flat().zeros_like(),
            second: params.flat().zeros_like(),
            steps: 0,
        }
    }

    /// One step along `gradients`, one per parameter in their order; what no gradient reached counts as zero.
    pub fn step(&mut self, params: &Params, gradients: &[Tensor]) -> Tensor {
        let _guard = tch::no_grad_guard();
        let norms: Vec<Tensor> = gradients
            .iter()
            .filter(|gradient| gradient.defined())
            .map(Tensor::norm)
            .collect();
        let norm = Tensor::stack(&norms, 0).norm();
        // As torch.nn.utils.clip_grad_norm_: scale = min(1, clip / (norm + 1e-6)).
        let scale = ((&norm + 1e-6).reciprocal() * self.grad_clip).clamp_max(1.0);
        self.steps += 1;
        let on_cpu = params.device() == Device::Cpu;
        let known_scale = on_cpu.then(|| scale.double_value(&[]));
        let mut offset = 0;
        for (parameter, gradient) in params.tensors().into_iter().zip(gradients) {
            let count = parameter.numel() as i64;
            let gradient = if gradient.defined() {
                gradient.reshape([count])
            } else {
                scale.zeros_like().expand([count], false)
            };
            match known_scale {
                Some(scale) => self.step_in_one_pass(params, offset, &gradient, scale),
                None => self.step_tensors(params, offset, &(gradient * &scale)),
            }
            offset += count;
        }
        norm
    }

    /// The step of the parameters from `offset` on, along a clipped gradient `[len]`, on any device.
    fn step_tensors(&mut self, params: &Params, offset: i64, gradient: &Tensor) {
        let slice = |flat: &Tensor| flat.narrow(0, offset, gradient.size()[0]);
        let (mut first, mut second) = (slice(&self.first), slice(&self.second));
        let _ = first.lerp_(gradient, 1.0 - BETA1);
        let _ = second.g_mul_scalar_(BETA2);
        let _ = second.addcmul_(&(gradient * (1.0 - BETA2)), gradient);
        let [step_size, correction] = self.corrections();
        let denominator = second.sqrt() / correction + self.eps;
        let _ = slice(params.flat()).addcdiv_(&(first * -step_size), &denominator);
    }

    /// As [`Self::step_tensors`] on the CPU, along `gradient * scale`: every number is read and written once, where
    /// tensor operations pass the memory ten times.
    fn step_in_one_pass(&mut self, params: &Params, offset: i64, gradient: &Tensor, scale: f64) {
        let len = gradient.size()[0];
        let mut gradient = gradient.contiguous();
        let [step_size, correction] = self.corrections().map(|x| x as f32);
        let (scale, eps) = (scale as f32, self.eps as f32);
        let (rate1, beta2) = ((1.0 - BETA1) as f32, BETA2 as f32);
        let rate2 = (1.0 - BETA2) as f32;
        let mut flat = params.flat().narrow(0, offset, len);
        let mut first = self.first.narrow(0, offset, len);
        let mut second = self.second.narrow(0, offset, len);
        // SAFETY: all four are contiguous `f32` of `len` numbers on the CPU, of different tensors, and no other thread
        // computes between two jobs of an update.
        let [parameters, first, second, gradient] =
            [&mut flat, &mut first, &mut second, &mut gradient].map(|x| unsafe { numbers(x) });
        for (((p, m), v), g) in parameters.iter_mut().zip(first).zip(second).zip(gradient) {
            let g = *g * scale;
            *m += rate1 * (g - *m);
            *v = beta2 * *v + rate2 * g * g;
            *p -= step_size * *m / (v.sqrt() / correction + eps);
        }
    }

    /// `lr / (1 - beta1^t)` and `sqrt(1 - beta2^t)`.
    fn corrections(&self) -> [f64; 2] {
        let steps = self.steps as i32;
        [
            self.lr * self.lr_factor / (1.0 - BETA1.powi(steps)),
            (1.0 - BETA2.powi(steps)).sqrt(),
        ]
    }
}

/// The numbers of a contiguous `f32` tensor on the CPU.
///
/// # Safety
/// Nothing else may use them meanwhile.
unsafe fn numbers(tensor: &mut Tensor) -> &mut [f32] {
    // SAFETY: the caller's.
    unsafe { std::slice::from_raw_parts_mut(tensor.data_ptr().cast(), tensor.numel()) }
}

#[cfg(test)]
mod tests {
    use tch::Kind;

    use super::*;

    #[test]
    fn one_pass_is_the_step_of_tensor_operations() {
        tch::manual_seed(9);
        let settings = OptimizerConfig::default();
        let group = || {
            let mut params = Params::new(Device::Cpu);
            let _ = params.root("net").uniform("weight", &[7, 5], 0.5);
            params.flatten();
            let adam = Adam::new(&params, 1e-2, &settings);
            (params, adam)
        };
        let (plain, mut by_tensors) = group();
        let (fast, mut in_one_pass) = group();
        tch::no_grad(|| fast.flat().shallow_clone().copy_(plain.flat()));
        let _guard = tch::no_grad_guard();
        for _ in 0..5 {
            let gradient = Tensor::randn([35], (Kind::Float, Device::Cpu));
            by_tensors.steps += 1;
            in_one_pass.steps += 1;
            by_tensors.step_tensors(&plain, 0, &(&gradient * 0.5));
            in_one_pass.step_in_one_pass(&fast, 0, &gradient, 0.5);
        }
        for (a, b) in [
            (plain.flat(), fast.flat()),
            (&by_tensors.first, &in_one_pass.first),
            (&by_tensors.second, &in_one_pass.second),
        ] {
            assert!(a.allclose(b, 1e-5, 1e-7, false));
        }
    }
}
