//! Random numbers of networks: libtorch's generator, or one of the calling thread's own.
//!
//! libtorch has one generator for all threads of a process. Where several threads learn side by side, the order in which
//! they ask it is left to chance, and with it every number they get. Inside [`seeded`] a thread draws from a stream that
//! follows from a seed alone, so that an update can be made again.

use std::cell::RefCell;

use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use tch::{Device, Kind, Tensor};

thread_local! {
    static STREAM: RefCell<Option<ChaCha8Rng>> = const { RefCell::new(None) };
}

/// Runs `f` with random numbers that follow from `seed`. On the CPU they are the thread's own; on another device libtorch's
/// generator is seeded.
pub fn seeded<T>(seed: u64, device: Device, f: impl FnOnce() -> T) -> T {
    if device != Device::Cpu {
        tch::manual_seed(seed as i64);
        return f();
    }
    let before = STREAM.replace(Some(ChaCha8Rng::seed_from_u64(seed)));
    let result = f();
    STREAM.set(before);
    result
}

/// Standard normal numbers in the shape of `x`.
pub fn normal_like(x: &Tensor) -> Tensor {
    own(x, |rng| rng.sample(StandardNormal)).unwrap_or_else(|| x.randn_like())
}

/// Uniform numbers in `[0, 1)` in the shape of `x`.
pub fn uniform_like(x: &Tensor) -> Tensor {
    own(x, |rng| rng.random()).unwrap_or_else(|| x.rand_like())
}

/// `count` different rows of `total`, in random order: `[count]`.
pub fn choose(total: i64, count: i64, device: Device) -> Tensor {
    let order = STREAM.with_borrow_mut(|stream| {
        let rng = stream.as_mut()?;
        let mut order: Vec<i64> = (0..total).collect();
        order.shuffle(rng);
        Some(Tensor::from_slice(&order))
    });
    order
        .unwrap_or_else(|| Tensor::randperm(total, (Kind::Int64, device)))
        .narrow(0, 0, count)
}

/// Numbers of the thread's own stream in the shape of `x`; none where it has no stream.
fn own(x: &Tensor, mut draw: impl FnMut(&mut ChaCha8Rng) -> f32) -> Option<Tensor> {
    STREAM.with_borrow_mut(|stream| {
        let rng = stream.as_mut()?;
        let numbers: Vec<f32> = (0..x.numel()).map(|_| draw(rng)).collect();
        Some(Tensor::from_slice(&numbers).view_as(x))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_decides_and_moments_are_those_of_the_distributions() {
        let zeros = Tensor::zeros([100, 100], (Kind::Float, Device::Cpu));
        let draw = |seed| {
            seeded(seed, Device::Cpu, || {
                (
                    normal_like(&zeros),
                    uniform_like(&zeros),
                    choose(50, 20, Device::Cpu),
                )
            })
        };
        let (normal, uniform, rows) = draw(3);
        let again = draw(3);
        assert!(normal.equal(&again.0) && uniform.equal(&again.1) && rows.equal(&again.2));
        assert!(!normal.equal(&draw(4).0));
        let moments = |x: &Tensor| {
            let mean = x.mean(Kind::Float).double_value(&[]);
            (mean, x.std(false).double_value(&[]))
        };
        let (mean, std) = moments(&normal);
        assert!(
            mean.abs() < 0.04 && (std - 1.0).abs() < 0.03,
            "{mean} {std}"
        );
        let (mean, std) = moments(&uniform);
        let expected = (1.0 / 12.0_f64).sqrt();
        assert!((mean - 0.5).abs() < 0.02 && (std - expected).abs() < 0.01);
        let mut chosen = Vec::<i64>::try_from(rows).expect("whole numbers");
        chosen.sort_unstable();
        chosen.dedup();
        assert_eq!(chosen.len(), 20);
    }
}
