//! Eq. 14: returns, losses, the actor's distribution, and the optimiser.

use isodream_core::config::OptimizerConfig;
use isodream_model::behavior::{actor_loss, critic_loss, lambda_return, step_weights};
use isodream_model::distribution::TruncatedNormal;
use isodream_model::optimizer::Adam;
use tch::{Kind, Tensor};

use crate::{assert_close, assert_gradients, at, leaf, number, params, set, tensor};

#[test]
fn lambda_returns_and_weights() {
    let rewards = tensor("lambda_return.inputs.rewards");
    let values = tensor("lambda_return.inputs.values");
    let lambda = number("lambda_return.inputs.lambda");
    let constant = rewards.full_like(number("lambda_return.inputs.discount"));
    let varying = tensor("lambda_return.inputs.discounts");
    for (case, discounts) in [("scalar", constant), ("per_step", varying)] {
        let returns = lambda_return(&rewards, &values, &discounts, lambda);
        let with_last = Tensor::cat(&[returns, values.narrow(0, values.size()[0] - 1, 1)], 0);
        assert_close(&with_last, &format!("lambda_return.outputs.{case}.returns"));
        let weights = tensor(&format!("lambda_return.outputs.{case}.weights"));
        let steps = weights.size()[0] - 1;
        assert!(step_weights(&discounts).allclose(&weights.narrow(0, 0, steps), 1e-5, 1e-6, false));
    }
}

#[test]
fn truncated_normal() {
    let mean = leaf("truncated_normal.inputs.mean");
    let std = leaf("truncated_normal.inputs.std");
    // One action dimension per row, so that sums over dimensions change nothing.
    let column = |x: &Tensor| x.view([-1, 1]);
    let single = TruncatedNormal {
        mean: column(&mean),
        std: column(&std),
    };
    let entropy = single.entropy();
    assert_close(&entropy, "truncated_normal.outputs.entropy");
    assert_gradients(
        &entropy.sum(Kind::Float),
        &[
            (&mean, "truncated_normal.outputs.dentropy_dmean".into()),
            (&std, "truncated_normal.outputs.dentropy_dstd".into()),
        ],
    );

    let pair = TruncatedNormal {
        mean: Tensor::stack(&[&mean, &mean], -1),
        std: Tensor::stack(&[&std, &std], -1),
    };
    assert!(
        pair.entropy()
            .allclose(&(single.entropy() * 2.0), 1e-5, 1e-6, false),
        "entropy is a sum over action dimensions"
    );

    let x = tensor("truncated_normal.inputs.x");
    let (rows, columns) = (x.size()[0], x.size()[1]);
    let grid = |x: &Tensor| x.view([-1, 1, 1]).expand([rows, columns, 1], false);
    let many = TruncatedNormal {
        mean: grid(&mean),
        std: grid(&std),
    };
    assert_close(
        &many.log_prob(&x.unsqueeze(-1)),
        "truncated_normal.outputs.log_prob",
    );

    let u = tensor("truncated_normal.inputs.u");
    let broadcast = TruncatedNormal {
        mean: column(&mean).expand(u.size().as_slice(), false),
        std: column(&std).expand(u.size().as_slice(), false),
    };
    let sample = broadcast.quantile(&u);
    assert_close(&sample, "truncated_normal.outputs.sample");
    assert!(sample.abs().max().double_value(&[]) < 1.0);
    // The gradients differ per column of u; the sums over columns are compared.
    let gradients = Tensor::run_backward(&[sample.sum(Kind::Float)], &[&mean, &std], false, false);
    for (gradient, want) in gradients.iter().zip(["dsample_dmean", "dsample_dstd"]) {
        let want = tensor(&format!("truncated_normal.outputs.{want}"));
        let want = want.sum_dim_intlist([1_i64].as_slice(), false, Kind::Float);
        assert!(
            gradient.allclose(&want, 1e-4, 1e-5, false),
            "{gradient} {want}"
        );
    }
}

#[test]
fn actor_and_critic_losses() {
    let input = |entry: &str, name: &str| {
        let all = leaf(&format!("{entry}.inputs.{name}"));
        let steps = all.size()[0] - 1;
        let used = all.narrow(0, 0, steps);
        (all, used)
    };
    for (case, scale) in [
        ("standard", "entropy_scale"),
        ("large", "entropy_scale_large"),
    ] {
        let (all_returns, returns) = input("actor_loss", "returns");
        let (all_entropies, entropies) = input("actor_loss", "entropies");
        let (_, weights) = input("actor_loss", "weights");
        let scale = number(&format!("actor_loss.inputs.{scale}"));
        let loss = actor_loss(&returns, &entropies, &weights, scale);
        let want = |name: &str| format!("actor_loss.outputs.{case}.{name}");
        assert_close(&loss, &want("loss"));
        assert_gradients(
            &loss,
            &[
                (&all_returns, want("grad_returns")),
                (&all_entropies, want("grad_entropies")),
            ],
        );
    }
    let (all_values, values) = input("critic_loss", "values");
    let (_, returns) = input("critic_loss", "returns");
    let (_, weights) = input("critic_loss", "weights");
    let loss = critic_loss(&values, &returns, &weights);
    assert_close(&loss, "critic_loss.outputs.loss");
    assert_gradients(
        &loss,
        &[(&all_values, "critic_loss.outputs.grad_values".into())],
    );
}

#[test]
fn mean_and_standard_deviation_of_the_actor() {
    let raw = tensor("std_transform.inputs.raw");
    let distribution = TruncatedNormal::from_raw(&Tensor::stack(&[&raw, &raw], -1), 0.1);
    assert_close(
        &distribution.std.squeeze_dim(-1),
        "std_transform.outputs.std",
    );
    let mean = distribution.mean.squeeze_dim(-1);
    assert!(mean.allclose(&raw.tanh(), 1e-6, 1e-6, false));
}

#[test]
fn adam_with_clipping() {
    let mut params = params();
    {
        let mut root = params.root("group");
        let _ = root.constant("p0", &[3, 2], 0.0);
        let _ = root.constant("p1", &[4], 0.0);
    }
    set(&params, "p0", "adam.inputs.params.p0");
    set(&params, "p1", "adam.inputs.params.p1");
    params.flatten();
    let config = OptimizerConfig {
        eps: number("adam.inputs.eps"),
        grad_clip: number("adam.inputs.clip"),
        ..OptimizerConfig::default()
    };
    let mut adam = Adam::new(&params, number("adam.inputs.lr"), &config);
    let list = |path: &str| at(path).as_array().expect("a list").len();
    let flat = |value: &serde_json::Value| {
        let mut values = Vec::new();
        for name in ["p0", "p1"] {
            crate::collect(&value[name], &mut Vec::new(), 0, &mut values);
        }
        Tensor::from_slice(&values)
    };
    let close = |got: &Tensor, want: &Tensor, what: &str| {
        let error = (got - want).abs().max().double_value(&[]);
        let scale = want.abs().max().double_value(&[]);
        assert!(error <= 1e-5 * scale, "{what}: off by {error} at {scale}");
    };
    for step in 0..list("adam.inputs.grads") {
        let gradients = flat(&at("adam.inputs.grads")[step]).split_with_sizes([6, 4], 0);
        let norm = adam.step(&params, &gradients);
        let want = &at("adam.outputs.steps")[step];
        let want_norm = want["grad_norm"].as_f64().expect("a number");
        assert!((norm.double_value(&[]) - want_norm).abs() <= 1e-5 * want_norm);
        close(params.flat(), &flat(&want["params"]), "parameters");
        close(&adam.first, &flat(&want["exp_avg"]), "first moment");
        close(&adam.second, &flat(&want["exp_avg_sq"]), "second moment");
    }
}
