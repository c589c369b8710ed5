//! The actor's distribution: a Gaussian truncated to `[-1, 1]`, as in DreamerV2.
//!
//! The authors' code means to use it but samples an untruncated Gaussian by mistake; this one is real.

use tch::{Kind, Tensor};

use crate::losses::HALF_LOG_2PI;
use crate::noise::uniform_like;

/// Samples stay this far from the bounds.
const MARGIN: f64 = 1e-6;

/// A product of Gaussians truncated to `[-1, 1]`, `[.., A]`.
#[derive(Debug)]
pub struct TruncatedNormal {
    /// Of the untruncated Gaussian, in `(-1, 1)`; also the mode.
    pub mean: Tensor,
    /// Of the untruncated Gaussian.
    pub std: Tensor,
}

struct Bounds {
    /// `(-1 - mean) / std`.
    alpha: Tensor,
    /// `(1 - mean) / std`.
    beta: Tensor,
    /// `Phi(alpha)`.
    below: Tensor,
    /// `Z = Phi(beta) - Phi(alpha)`.
    mass: Tensor,
}

impl TruncatedNormal {
    /// From the actor's raw outputs: `mean = tanh(m)`, `std = 2 sigmoid(raw / 2) + min_std`.
    ///
    /// # Shapes
    /// `[.., 2 A]`
    pub fn from_raw(raw: &Tensor, min_std: f64) -> Self {
        let halves = raw.chunk(2, -1);
        Self {
            mean: halves[0].tanh(),
            std: (&halves[1] / 2.0).sigmoid() * 2.0 + min_std,
        }
    }

    /// A reparameterised sample by the inverse distribution function.
    pub fn sample(&self) -> Tensor {
        self.quantile(&uniform_like(&self.mean))
    }

    /// `mean + std Phi^-1(Phi(alpha) + u Z)`: the sample that the uniform number `u` stands for.
    ///
    /// # Shapes
    /// `u: [.., A]` in `[0, 1)`
    pub fn quantile(&self, u: &Tensor) -> Tensor {
        let bounds = self.bounds();
        let p = (bounds.below + u * bounds.mass).clamp(MARGIN, 1.0 - MARGIN);
        let standard = (p * 2.0 - 1.0).erfinv() * std::f64::consts::SQRT_2;
        let sample = &self.mean + &self.std * standard;
        let clipped = sample.clamp(-1.0 + MARGIN, 1.0 - MARGIN);
        // Straight-through clip, as in DreamerV2: the value is inside, the gradient passes.
        (clipped - &sample).detach() + sample
    }

    /// The most likely action.
    pub fn mode(&self) -> Tensor {
        self.mean.shallow_clone()
    }

    /// `ln pi(a)`, summed over action dimensions.
    ///
    /// # Shapes
    /// `[.., A] -> [..]`
    pub fn log_prob(&self, action: &Tensor) -> Tensor {
        let standard = (action - &self.mean) / &self.std;
        let log =
            standard.square() * -0.5 - HALF_LOG_2PI - self.std.log() - self.bounds().mass.log();
        sum_last(&log)
    }

    /// `H = ln(sqrt(2 pi e) std Z) + (alpha phi(alpha) - beta phi(beta)) / (2 Z)`, summed over action
    /// dimensions.
    ///
    /// # Shapes
    /// `[.., A] -> [..]`
    pub fn entropy(&self) -> Tensor {
        let bounds = self.bounds();
        let density = |x: &Tensor| (x.square() * -0.5 - HALF_LOG_2PI).exp();
        let edges = &bounds.alpha * density(&bounds.alpha) - &bounds.beta * density(&bounds.beta);
        let entropy =
            (&self.std * &bounds.mass).log() + (HALF_LOG_2PI + 0.5) + edges / (&bounds.mass * 2.0);
        sum_last(&entropy)
    }

    fn bounds(&self) -> Bounds {
        let alpha: Tensor = (-1.0 - &self.mean) / &self.std;
        let beta: Tensor = (1.0 - &self.mean) / &self.std;
        let below = alpha.special_ndtr();
        let mass = beta.special_ndtr() - &below;
        Bounds {
            alpha,
            beta,
            below,
            mass,
        }
    }
}

/// `sum_A max(0, |m| - limit)^2` of the actor's raw outputs. Beyond a limit of 1, `tanh` is flat: an actor that goes there
/// gets no gradient to come back by, so that `behavior.mean_penalty` weighs this.
///
/// # Shapes
/// `[.., 2 A] -> [..]`
pub fn saturation(raw: &Tensor, limit: f64) -> Tensor {
    let m = &raw.chunk(2, -1)[0];
    sum_last(&(m.abs() - limit).relu().square())
}

fn sum_last(x: &Tensor) -> Tensor {
    x.sum_dim_intlist([-1_i64].as_slice(), false, Kind::Float)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn saturation_grows_beyond_one_and_keeps_its_gradient() {
        // Two action dimensions: (3 - 1)^2 + (1.5 - 1)^2; the second half is the widths'.
        let raw = Tensor::from_slice(&[-3.0_f32, 1.5, 9.0, 9.0]).set_requires_grad(true);
        let penalty = saturation(&raw, 1.0);
        assert!((penalty.double_value(&[]) - 4.25).abs() < 1e-6);
        let gradient = Tensor::run_backward(&[penalty], &[&raw], false, false);
        let gradient = Vec::<f32>::try_from(&gradient[0]).expect("numbers");
        assert_eq!(gradient, [-4.0, 1.0, 0.0, 0.0]);
        let inside = saturation(&Tensor::from_slice(&[0.9_f32, -0.5, 0.0, 0.0]), 1.0);
        assert_eq!(inside.double_value(&[]), 0.0);
        // Without a limit, all of it: 0.81 + 0.25.
        let squared = saturation(&Tensor::from_slice(&[0.9_f32, -0.5, 0.0, 0.0]), 0.0);
        assert!((squared.double_value(&[]) - 1.06).abs() < 1e-6);
    }

    #[test]
    fn the_least_width_is_that_of_the_configuration() {
        let narrow = TruncatedNormal::from_raw(&Tensor::from_slice(&[0.0_f32, -80.0]), 0.25);
        assert!((narrow.std.double_value(&[0]) - 0.25).abs() < 1e-6);
    }
}
