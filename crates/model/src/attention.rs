//! Future-state attention (Iso-Dream++ Eq. 13).

use isodream_core::config::ModelConfig;
use tch::Tensor;

use crate::nn::Linear;
use crate::params::Scope;

/// `e_t = W_o (softmax(W_q s_t (W_k z_{t:t+tau})^T / sqrt(d)) W_v z_{t:t+tau}) + s_t`.
///
/// Learned projections and scaling are the authors' code; the paper's text has neither.
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
        let query = self.query.forward(controllable).unsqueeze(1);
        let key = self.key.forward(memory);
        let dim = key.size()[2] as f64;
        let weights = (query.matmul(&key.transpose(1, 2)) / dim.sqrt()).softmax(-1, None);
        let value = self.value.forward(memory);
        let read = weights.matmul(&value).squeeze_dim(1);
        Attended {
            feat: self.out.forward(&read) + controllable,
            weights: weights.squeeze_dim(1),
        }
    }
}
