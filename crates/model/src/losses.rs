//! The terms of the world-model loss (Iso-Dream++ Eq. 6, 8-10), each a function of tensors.

use tch::{Kind, Tensor};

use crate::rssm::Gaussian;

/// `0.5 ln(2 pi)`: the constant of a unit Gaussian's negative log-likelihood.
pub const HALF_LOG_2PI: f64 = 0.918_938_533_204_672_7;

/// `-ln Normal(target; prediction, 1)`, summed over the last `dims` axes and averaged over the others.
pub fn gaussian_nll(prediction: &Tensor, target: &Tensor, dims: usize) -> Tensor {
    let size = target.size();
    let (kept, summed) = size.split_at(size.len() - dims);
    let rows = kept.iter().product::<i64>() as f64;
    let constant = HALF_LOG_2PI * summed.iter().product::<i64>() as f64;
    (prediction - target).square().sum(Kind::Float) * (0.5 / rows) + constant
}

/// `KL[q || p]` of diagonal Gaussians, summed over the last axis.
///
/// # Shapes
/// `[.., stoch] -> [..]`
pub fn kl_divergence(q: &Gaussian, p: &Gaussian) -> Tensor {
    let variance_ratio = (&q.std / &p.std).square();
    let distance = ((&q.mean - &p.mean) / &p.std).square();
    let kl = (&variance_ratio + distance - 1.0 - variance_ratio.log()) * 0.5;
    kl.sum_dim_intlist([-1_i64].as_slice(), false, Kind::Float)
}

/// DreamerV2's balanced KL of one branch:
/// `b max(mean KL[sg q || p], free) + (1 - b) max(mean KL[q || sg p], free)`,
/// free nats applied after averaging.
pub fn balanced_kl(posterior: &Gaussian, prior: &Gaussian, balance: f64, free_nats: f64) -> Tensor {
    let train_prior = kl_divergence(&posterior.detach(), prior).mean(Kind::Float);
    let train_posterior = kl_divergence(posterior, &prior.detach()).mean(Kind::Float);
    train_prior.clamp_min(free_nats) * balance
        + train_posterior.clamp_min(free_nats) * (1.0 - balance)
}

/// Controllable variance constraint, authors' form of Eq. 8: `mean |cos(h(a), h(-a))|`. Minimised, it
/// pushes the outcomes of opposite actions apart.
///
/// # Shapes
/// `[.., deter]` twice `-> []`
pub fn max_action_loss(with_action: &Tensor, with_opposite: &Tensor) -> Tensor {
    Tensor::cosine_similarity(with_action, with_opposite, -1, 1e-8)
        .abs()
        .mean(Kind::Float)
}

/// Noncontrollable variance constraint, authors' form of Eq. 9:
/// `sum (h'(0) - h'(-a))^2 + (h'(a) - h'(0))^2`, a sum over everything.
///
/// # Shapes
/// `[.., deter]` thrice `-> []`
pub fn min_free_loss(with_none: &Tensor, with_action: &Tensor, with_opposite: &Tensor) -> Tensor {
    (with_none - with_opposite).square().sum(Kind::Float)
        + (with_action - with_none).square().sum(Kind::Float)
}

/// The paper's text of Eq. 8 and 9: the sample variance over hypothetical actions, summed over time and
/// latent dimensions, averaged over the batch.
///
/// # Shapes
/// each sample `[B, T, stoch]`, at least two `-> []`
pub fn sample_variance(samples: &[Tensor]) -> Tensor {
    let batch = samples[0].size()[0] as f64;
    Tensor::stack(samples, 0)
        .var_dim([0_i64].as_slice(), true, false)
        .sum(Kind::Float)
        / batch
}
