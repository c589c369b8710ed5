//! Eq. 3 and 11-13.

use isodream_core::config::ModelConfig;
use isodream_model::attention::FutureAttention;
use isodream_model::gate::DependencyGate;
use isodream_model::nn::GruCell;
use isodream_model::rssm::Branch;
use tch::Tensor;

use crate::{assert_close, assert_gradients, leaf, params, set, tensor, weighted_sum};

fn sizes(stoch: i64, deter: i64, hidden: i64) -> ModelConfig {
    ModelConfig {
        stoch,
        deter,
        hidden,
        ..ModelConfig::default()
    }
}

#[test]
fn gru_cell() {
    let mut params = params();
    let gru = GruCell::new(params.root("gru"), 5, 4);
    set(&params, "joint.weight", "gru_cell.inputs.weight");
    set(&params, "joint.bias", "gru_cell.inputs.bias");
    set(&params, "norm.weight", "gru_cell.inputs.ln_gamma");
    set(&params, "norm.bias", "gru_cell.inputs.ln_beta");
    let next = gru.forward(&tensor("gru_cell.inputs.x"), &tensor("gru_cell.inputs.h"));
    assert_close(&next, "gru_cell.outputs.h_next");
}

#[test]
fn rssm_step() {
    let mut params = params();
    let branch = Branch::new(params.root("branch"), &sizes(3, 4, 5), 2, 6);
    let input = |name: &str| format!("rssm_step.inputs.{name}");
    for (name, golden) in [
        ("input.weight", "in_w"),
        ("input.bias", "in_b"),
        ("joint.weight", "gru_weight"),
        ("joint.bias", "gru_bias"),
        ("norm.weight", "gru_ln_gamma"),
        ("norm.bias", "gru_ln_beta"),
        ("branch.prior.weight", "prior_hidden_w"),
        ("branch.prior.bias", "prior_hidden_b"),
        ("prior_stats.weight", "prior_out_w"),
        ("prior_stats.bias", "prior_out_b"),
        ("posterior.weight", "post_hidden_w"),
        ("posterior.bias", "post_hidden_b"),
        ("posterior_stats.weight", "post_out_w"),
        ("posterior_stats.bias", "post_out_b"),
    ] {
        set(&params, name, &input(golden));
    }
    let (stoch, before) = (tensor(&input("stoch")), tensor(&input("deter")));
    let action = tensor(&input("action"));
    let deter = branch.transition(&stoch, &action, &before);
    assert_close(&deter, "rssm_step.outputs.deter");
    assert_close(
        &branch.transition(&stoch, &action.neg(), &before),
        "rssm_step.outputs.deter_neg",
    );
    assert_close(
        &branch.transition(&stoch, &action.zeros_like(), &before),
        "rssm_step.outputs.deter_zero",
    );

    let prior = branch.prior(&deter);
    assert_close(&prior.mean, "rssm_step.outputs.prior_mean");
    assert_close(&prior.std, "rssm_step.outputs.prior_std");
    let posterior = branch.posterior(&deter, &branch.project_embed(&tensor(&input("embed"))));
    assert_close(&posterior.mean, "rssm_step.outputs.post_mean");
    assert_close(&posterior.std, "rssm_step.outputs.post_std");
}

#[test]
fn dependency_gate_forward_and_straight_through() {
    let mut params = params();
    let gate = DependencyGate::new(params.root("dependency"), &sizes(3, 4, 5));
    let input = |name: &str| format!("gate.inputs.{name}");
    set(&params, "gate.weight", &input("gate_w"));
    set(&params, "gate.bias", &input("gate_b"));
    set(&params, "merge.weight", &input("merge_w"));
    set(&params, "merge.bias", &input("merge_b"));
    let [deter_z, deter_s, stoch_z, stoch_s] =
        ["deter_z", "deter_s", "stoch_z", "stoch_s"].map(|n| leaf(&input(n)));

    let open = gate.open(&deter_z, &deter_s);
    assert_close(&open, "gate.outputs.w");
    let inputs = |of: &str, with_stoch: bool| -> Vec<(Tensor, String)> {
        let mut all = vec![
            (gate.gate.weight.shallow_clone(), "gate_w"),
            (gate.gate.bias.shallow_clone(), "gate_b"),
            (deter_z.shallow_clone(), "deter_z"),
            (deter_s.shallow_clone(), "deter_s"),
        ];
        if with_stoch {
            all.push((stoch_z.shallow_clone(), "stoch_z"));
            all.push((stoch_s.shallow_clone(), "stoch_s"));
        }
        all.into_iter()
            .map(|(t, n)| (t, format!("gate.outputs.{of}.{n}")))
            .collect()
    };
    let borrow = |all: &[(Tensor, String)], loss: &Tensor| {
        let all: Vec<_> = all.iter().map(|(t, n)| (t, n.clone())).collect();
        assert_gradients(loss, &all);
    };
    borrow(
        &inputs("from_grad_w", false),
        &weighted_sum(&open, &input("grad_w")),
    );

    let merged = gate.merge(&stoch_z, &stoch_s, &open);
    assert_close(&merged, "gate.outputs.z_in");
    assert_close(&gate.merge_shut(&stoch_z), "gate.outputs.z_in_closed");
    borrow(
        &inputs("from_grad_z_in", true),
        &weighted_sum(&merged, &input("grad_z_in")),
    );
}

#[test]
fn future_state_attention() {
    let mut params = params();
    let config = ModelConfig {
        attention_dim: 14,
        ..sizes(3, 4, 5)
    };
    let attention = FutureAttention::new(params.root("attention"), &config);
    for (name, letter) in [("query", 'q'), ("key", 'k'), ("value", 'v'), ("out", 'o')] {
        set(
            &params,
            &format!("{name}.weight"),
            &format!("attention.inputs.w{letter}"),
        );
        set(
            &params,
            &format!("{name}.bias"),
            &format!("attention.inputs.b{letter}"),
        );
    }
    let attended = attention.forward(
        &tensor("attention.inputs.query"),
        &tensor("attention.inputs.memory"),
    );
    assert_close(&attended.weights, "attention.outputs.weights");
    assert_close(&attended.feat, "attention.outputs.e");
}
