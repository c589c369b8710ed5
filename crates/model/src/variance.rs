//! What other actions would have done to the next state (Iso-Dream++ Eq. 8, 9).

use isodream_core::config::VarianceLoss;
use tch::Tensor;

use crate::losses::{max_action_loss, min_free_loss, sample_variance};
use crate::rssm::{Branch, Observed, Rssm};

/// The min-max variance constraints (Eq. 8, 9) under `{a, -a}` and `{a, 0, -a}`. The real transitions
/// are the scan's own; the hypothetical ones have no recurrence and run as one batch.
///
/// # Shapes
/// `actions: [B, T, A]`, observed `[B, T, ..] -> []` twice: controllable, noncontrollable
pub(crate) fn variance_losses(
    rssm: &Rssm,
    form: VarianceLoss,
    actions: &Tensor,
    observed: &Observed,
) -> (Tensor, Tensor) {
    let actions = actions.flatten(0, 1);
    let opposite = actions.neg();
    let from = observed.previous.map(|x| x.flatten(0, 1));
    let (s, z) = (&from.controllable, &from.noncontrollable);
    let s_action = observed.states.controllable.deter.flatten(0, 1);
    let s_opposite = rssm.controllable.transition(&s.stoch, &opposite, &s.deter);
    let z_none = observed.states.noncontrollable.deter.flatten(0, 1);
    let twice = |x: &Tensor| x.repeat([2, 1]);
    let z_both = rssm
        .noncontrollable
        .transition(
            &twice(&z.stoch),
            &Tensor::cat(&[&actions, &opposite], 0),
            &twice(&z.deter),
        )
        .chunk(2, 0);
    match form {
        VarianceLoss::Deter => (
            max_action_loss(&s_action, &s_opposite),
            min_free_loss(&z_none, &z_both[0], &z_both[1]),
        ),
        VarianceLoss::Paper => {
            let length = observed.states.controllable.deter.size()[1];
            let sample = |branch: &Branch, deter: &Tensor| {
                branch.prior(deter).sample().unflatten(0, [-1, length])
            };
            let (s, z) = (&rssm.controllable, &rssm.noncontrollable);
            (
                -sample_variance(&[sample(s, &s_action), sample(s, &s_opposite)]),
                sample_variance(&[
                    sample(z, &z_both[0]),
                    sample(z, &z_none),
                    sample(z, &z_both[1]),
                ]),
            )
        }
    }
}
