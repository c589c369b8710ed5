//! Eq. 4-6 and 8-10.

use isodream_model::decoder::{Component, compose};
use isodream_model::losses::{
    balanced_kl, gaussian_nll, kl_divergence, max_action_loss, min_free_loss, sample_variance,
};
use isodream_model::rssm::Gaussian;
use tch::{Kind, Tensor};

use crate::{assert_close, assert_gradients, leaf, number, tensor};

#[test]
fn kl_with_balance_and_free_nats() {
    for case in ["above", "below"] {
        let input = |name: &str| leaf(&format!("kl.inputs.{case}.{name}"));
        let posterior = Gaussian {
            mean: input("post_mean"),
            std: input("post_std"),
        };
        let prior = Gaussian {
            mean: input("prior_mean"),
            std: input("prior_std"),
        };
        let want = |name: &str| format!("kl.outputs.{case}.{name}");
        assert_close(
            &kl_divergence(&posterior, &prior).mean(Kind::Float),
            &want("mean_kl"),
        );
        let loss = balanced_kl(
            &posterior,
            &prior,
            number("kl.inputs.balance"),
            number("kl.inputs.free"),
        );
        assert_close(&loss, &want("value"));
        assert_gradients(
            &loss,
            &[
                (&posterior.mean, want("grad_post_mean")),
                (&posterior.std, want("grad_post_std")),
                (&prior.mean, want("grad_prior_mean")),
                (&prior.std, want("grad_prior_std")),
            ],
        );
    }
}

#[test]
fn max_action() {
    let with = leaf("max_action.inputs.deter_pos");
    let opposite = leaf("max_action.inputs.deter_neg");
    let loss = max_action_loss(&with, &opposite);
    assert_close(&loss, "max_action.outputs.value");
    let want = |name: &str| format!("max_action.outputs.{name}");
    assert_gradients(
        &loss,
        &[
            (&with, want("grad_deter_pos")),
            (&opposite, want("grad_deter_neg")),
        ],
    );
}

#[test]
fn descending_max_action_parts_the_outcomes_of_opposite_actions() {
    let with = leaf("max_action.inputs.deter_pos");
    let opposite = leaf("max_action.inputs.deter_neg");
    let loss = max_action_loss(&with, &opposite);
    let gradients = Tensor::run_backward(&[&loss], &[&with, &opposite], false, false);
    let after = max_action_loss(
        &(&with - &gradients[0] * 0.1),
        &(&opposite - &gradients[1] * 0.1),
    );
    assert!(
        after.lt_tensor(&loss).int64_value(&[]) == 1,
        "cosine {loss} -> {after}"
    );
}

#[test]
fn min_free() {
    let none = leaf("min_free.inputs.deter_zero");
    let opposite = leaf("min_free.inputs.deter_neg");
    let with = leaf("min_free.inputs.deter_pos");
    let loss = min_free_loss(&none, &with, &opposite);
    assert_close(&loss, "min_free.outputs.value");
    let want = |name: &str| format!("min_free.outputs.{name}");
    assert_gradients(
        &loss,
        &[
            (&none, want("grad_deter_zero")),
            (&opposite, want("grad_deter_neg")),
            (&with, want("grad_deter_pos")),
        ],
    );
}

#[test]
fn variance_in_the_papers_form() {
    let s = tensor("variance_paper.inputs.samples_s").unbind(0);
    let z = tensor("variance_paper.inputs.samples_z").unbind(0);
    assert_close(&sample_variance(&s), "variance_paper.outputs.var_s");
    assert_close(&sample_variance(&z), "variance_paper.outputs.var_z");
}

#[test]
fn composition_of_the_branches() {
    let inputs = ["rgb_s", "rgb_z", "mask_logit_s", "mask_logit_z"]
        .map(|n| leaf(&format!("composition.inputs.{n}")));
    let background = leaf("composition.inputs.background");
    let observed = tensor("composition.inputs.obs");
    let size = observed.size();
    let (batch, length) = (size[0], size[1]);
    let component = |rgb: &Tensor, mask: &Tensor| {
        Component::from_channels(&Tensor::cat(&[rgb, mask], 2).flatten(0, 1))
    };
    let pictures = background
        .clamp(-0.5, 0.5)
        .unsqueeze(1)
        .expand(size.as_slice(), false)
        .flatten(0, 1);
    let composition = compose(
        component(&inputs[0], &inputs[2]),
        component(&inputs[1], &inputs[3]),
        pictures,
    );
    let unflatten = |x: &Tensor| x.unflatten(0, [batch, length]);
    assert_close(
        &unflatten(&composition.controllable.mask),
        "composition.outputs.mask_s",
    );
    assert_close(
        &unflatten(&composition.noncontrollable.mask),
        "composition.outputs.mask_z",
    );
    assert_close(&unflatten(&composition.image), "composition.outputs.o_hat");
    let loss = gaussian_nll(&composition.image, &observed.flatten(0, 1), 3);
    assert_close(&loss, "composition.outputs.image_loss");
    let want = |name: &str| format!("composition.outputs.grad_{name}");
    assert_gradients(
        &loss,
        &[
            (&inputs[0], want("rgb_s")),
            (&inputs[1], want("rgb_z")),
            (&inputs[2], want("mask_logit_s")),
            (&inputs[3], want("mask_logit_z")),
            (&background, want("background")),
        ],
    );
}

#[test]
fn inverse_dynamics_and_reward() {
    let predicted = leaf("inverse_loss.inputs.action_pred");
    let loss = gaussian_nll(&predicted, &tensor("inverse_loss.inputs.action"), 1);
    assert_close(&loss, "inverse_loss.outputs.value");
    assert_gradients(
        &loss,
        &[(&predicted, "inverse_loss.outputs.grad_action_pred".into())],
    );

    let predicted = leaf("reward_loss.inputs.reward_pred");
    let loss = gaussian_nll(&predicted, &tensor("reward_loss.inputs.reward"), 0)
        * number("reward_loss.inputs.scale");
    assert_close(&loss, "reward_loss.outputs.value");
    assert_gradients(
        &loss,
        &[(&predicted, "reward_loss.outputs.grad_reward_pred".into())],
    );
}
