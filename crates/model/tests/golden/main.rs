//! Every equation against `tests/golden/golden.json`, which `tests/golden/golden.py` computes independently
//! in numpy with 64-bit floats.

mod behavior;
mod losses;
mod networks;

use std::sync::LazyLock;

use isodream_model::Params;
use serde_json::Value;
use tch::{Device, Kind, Tensor};

static GOLDEN: LazyLock<Value> = LazyLock::new(|| {
    let text = include_str!("../../../../tests/golden/golden.json");
    serde_json::from_str(text).expect("golden.json is JSON")
});

/// The entry at a path such as `kl.inputs.above`.
fn at(path: &str) -> &'static Value {
    path.split('.').fold(&*GOLDEN, |value, key| {
        value
            .get(key)
            .unwrap_or_else(|| panic!("golden.json has no `{key}` of `{path}`"))
    })
}

fn number(path: &str) -> f64 {
    at(path).as_f64().expect("a number")
}

fn collect(value: &Value, shape: &mut Vec<i64>, depth: usize, into: &mut Vec<f32>) {
    match value {
        Value::Array(items) => {
            if shape.len() == depth {
                shape.push(items.len() as i64);
            }
            for item in items {
                collect(item, shape, depth + 1, into);
            }
        }
        number => into.push(number.as_f64().expect("a number") as f32),
    }
}

/// A nested list as a tensor.
fn tensor(path: &str) -> Tensor {
    let (mut shape, mut values) = (Vec::new(), Vec::new());
    collect(at(path), &mut shape, 0, &mut values);
    Tensor::from_slice(&values).view(shape.as_slice())
}

fn leaf(path: &str) -> Tensor {
    tensor(path).set_requires_grad(true)
}

/// Fails unless `got` is `want` within 1e-5 of the largest magnitude in `want`.
fn assert_close(got: &Tensor, want: &str) {
    let expected = tensor(want);
    assert_eq!(got.size(), expected.size(), "{want}: shape");
    let error = f64::try_from((got - &expected).abs().max()).expect("a number");
    let scale = f64::try_from(expected.abs().max()).expect("a number");
    assert!(
        error <= 1e-5 * scale,
        "{want}: off by {error} at a scale of {scale}"
    );
}

/// As [`assert_close`], for the gradients of `loss` with respect to `inputs`.
fn assert_gradients(loss: &Tensor, inputs: &[(&Tensor, String)]) {
    let tensors: Vec<&Tensor> = inputs.iter().map(|(tensor, _)| *tensor).collect();
    let gradients = Tensor::run_backward(&[loss], &tensors, true, false);
    for ((input, want), gradient) in inputs.iter().zip(gradients) {
        let gradient = if gradient.defined() {
            gradient
        } else {
            input.zeros_like()
        };
        assert_close(&gradient, want);
    }
}

/// Sets a parameter by the end of its name.
fn set(params: &Params, name: &str, path: &str) {
    let (_, parameter) = params
        .entries()
        .iter()
        .find(|(full, _)| full.ends_with(name))
        .unwrap_or_else(|| panic!("no parameter `{name}`"));
    tch::no_grad(|| parameter.shallow_clone().copy_(&tensor(path)));
}

fn params() -> Params {
    Params::new(Device::Cpu)
}

fn weighted_sum(x: &Tensor, weights: &str) -> Tensor {
    (x * tensor(weights)).sum(Kind::Float)
}
