//! Future-state attention (Iso-Dream++ Eq. 13).

use isodream_core::config::ModelConfig;
use tch::Tensor;

use crate::nn::Linear;
use crate::params::Scope;

/// `e_t = W_o (softmax(W_q s_t (W_k z_{t:t+tau})^T / sqrt(d)) W_v z_{t:t+tau}) + s_t`.
///
/// Learned projections and scaling are the authors' code; the paper's text has neither.
///
/// The memory itself is never projected. A score `q (W_k m + b_k)` is `(q W_k) m` plus a constant that the softmax
/// ignores, and weights that sum to 1 take a mean before `W_v` as well as after it: two products per query instead
/// of two per remembered state.
#[derive(Debug)]
pub struct FutureAttention {
    /// `W_q`: `[attention_dim, feat]`.
    pub query: Linear,
    /// `W_k`: `[attention_dim, feat]`.
    pub key: Linear,
    /// `W_v`: `[attention_dim, feat]`.
    pub value: Linear,
    /// `W_o`: `[feat, attention_dim]`.
    pub out: Linear,
}

/// What attention returns.
#[derive(Debug)]
pub struct Attended {
    /// `e_t`: `[N, feat]`.
    pub feat: Tensor,
    /// `[N, tau]`, sums to 1.
    pub weights: Tensor,
}

impl FutureAttention {
    /// The attention of `config`.
    pub fn new(mut scope: Scope<'_>, config: &ModelConfig) -> Self {
        let feat = config.stoch + config.deter;
        let dim = config.attention_dim;
        Self {
            query: Linear::new(scope.sub("query"), feat, dim),
            key: Linear::new(scope.sub("key"), feat, dim),
            value: Linear::new(scope.sub("value"), feat, dim),
            out: Linear::new(scope.sub("out"), dim, feat),
        }
    }

    /// # Shapes
    /// `controllable: [N, feat]`, `memory: [N, tau, feat]`
    pub fn forward(&self, controllable: &Tensor, memory: &Tensor) -> Attended {
        let dim = self.query.weight.size()[0] as f64;
        let query = self.key.transposed(&self.query.forward(controllable)) / dim.sqrt();
        let scores = memory.matmul(&query.unsqueeze(-1)).squeeze_dim(-1);
        let weights = scores.softmax(-1, None);
        let mean = weights.unsqueeze(1).matmul(memory).squeeze_dim(1);
        let read = self.value.forward(&mean);
        Attended {
            feat: self.out.forward(&read) + controllable,
            weights,
        }
    }
}

#[cfg(test)]
mod tests {
    use tch::{Device, Kind};

    use super::*;
    use crate::Params;

    /// Eq. 13 as it is written: keys and values of every remembered state.
    fn plain(attention: &FutureAttention, controllable: &Tensor, memory: &Tensor) -> Tensor {
        let query = attention.query.forward(controllable).unsqueeze(1);
        let key = attention.key.forward(memory);
        let dim = key.size()[2] as f64;
        let weights = (query.matmul(&key.transpose(1, 2)) / dim.sqrt()).softmax(-1, None);
        let read = weights.matmul(&attention.value.forward(memory));
        attention.out.forward(&read.squeeze_dim(1)) + controllable
    }

    #[test]
    fn projecting_queries_equals_projecting_the_memory() {
        tch::manual_seed(2);
        let config = ModelConfig {
            stoch: 3,
            deter: 5,
            attention_dim: 12,
            ..ModelConfig::default()
        };
        let mut params = Params::new(Device::Cpu);
        let attention = FutureAttention::new(params.root("attention"), &config);
        let options = (Kind::Float, Device::Cpu);
        let controllable = Tensor::randn([6, 8], options).set_requires_grad(true);
        let memory = Tensor::randn([6, 4, 8], options);
        let direction = Tensor::randn([6, 8], options);

        let fast = attention.forward(&controllable, &memory).feat;
        let wanted = plain(&attention, &controllable, &memory);
        assert!(fast.allclose(&wanted, 1e-4, 1e-5, false), "{fast} {wanted}");

        let mut inputs = params.tensors();
        inputs.push(&controllable);
        let gradients = |y: Tensor| {
            let loss = (y * &direction).sum(Kind::Float);
            Tensor::run_backward(&[loss], &inputs, false, false)
        };
        for (index, (a, b)) in gradients(fast).iter().zip(gradients(wanted)).enumerate() {
            if a.defined() {
                assert!(a.allclose(&b, 1e-4, 1e-5, false), "input {index}: {a} {b}");
            } else {
                // The softmax ignores the keys' bias.
                assert!(b.abs().max().double_value(&[]) < 1e-6, "input {index}: {b}");
            }
        }
    }
}
