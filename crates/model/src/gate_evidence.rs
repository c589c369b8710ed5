//! What the dependency gate (Eq. 11, 12) is worth: whether it opens where the agent makes others move otherwise, and what
//! the noncontrollable branch foresees with it and without.

use serde::Serialize;
use tch::{Kind, Tensor};

use crate::batch::Batch;
use crate::losses::kl_divergence;
use crate::world_model::WorldModel;

/// How the gate fits true interactions.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GateEvidence {
    /// Steps with an interaction, of all.
    pub interaction_share: f64,
    /// Steps in which the gate is open, of all.
    pub open_share: f64,
    /// The probability that the gate's logit is higher at a step with an interaction than at one without (area under
    /// the ROC curve); 0.5 is chance. None where all steps are of one kind.
    pub auc: Option<f64>,
    /// What the noncontrollable branch did not foresee at steps with an interaction. None where there are none.
    pub surprise: Option<Surprise>,
}

/// Mean KL divergence of the noncontrollable posterior from the prior, in nats.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Surprise {
    /// With the gate held open.
    pub open: f64,
    /// With the gate as it is.
    pub gated: f64,
    /// With the gate held shut.
    pub shut: f64,
}

/// Compares the gate with `interactions` (1 where there is one), both of the transition that led to each step.
/// None without a gate.
///
/// # Shapes
/// `interactions: [B, T]`
pub fn gate_evidence(
    world: &WorldModel,
    batch: &Batch,
    interactions: &Tensor,
) -> Option<GateEvidence> {
    let _guard = tch::no_grad_guard();
    let gate = world.rssm.gate.as_ref()?;
    let observed = world.encode(&batch.images, &batch.actions).observed;
    let steps = batch.actions.size()[1] - 1;
    // From the first state on: the initial one is zeros.
    let earlier = observed.states.map(|x| x.narrow(1, 0, steps).flatten(0, 1));
    let later = |x: &Tensor| x.narrow(1, 1, steps).flatten(0, 1);
    let (s, z) = (&earlier.controllable, &earlier.noncontrollable);
    let logit = gate.logit(&z.deter, &s.deter);
    let happened = later(interactions).gt(0.5);
    let posterior = observed.noncontrollable_posterior.map(later);
    let surprise = |open: &Tensor| {
        let gated = gate.merge(&z.stoch, &s.stoch, open);
        let deter = world.rssm.free_transition(&gated, &z.deter);
        let kl = kl_divergence(&posterior, &world.rssm.noncontrollable.prior(&deter));
        kl.masked_select(&happened)
            .mean(Kind::Double)
            .double_value(&[])
    };
    let open = gate.open(&z.deter, &s.deter);
    let any = happened.any().int64_value(&[]) != 0;
    Some(GateEvidence {
        interaction_share: share(&happened),
        open_share: share(&open),
        auc: auc(&logit.flatten(0, -1), &happened),
        surprise: any.then(|| Surprise {
            open: surprise(&open.ones_like()),
            gated: surprise(&open),
            shut: surprise(&open.zeros_like()),
        }),
    })
}

fn share(flags: &Tensor) -> f64 {
    flags
        .to_kind(Kind::Double)
        .mean(Kind::Double)
        .double_value(&[])
}

/// The area under the ROC curve of `scores` for `positive`; ties count half. None where all are of one kind.
///
/// # Shapes
/// `[N]` twice
fn auc(scores: &Tensor, positive: &Tensor) -> Option<f64> {
    let high = scores.masked_select(positive);
    let low = scores.masked_select(&positive.logical_not());
    if high.numel() == 0 || low.numel() == 0 {
        return None;
    }
    let difference = high.unsqueeze(1) - low.unsqueeze(0);
    let won = (difference.sign() + 1.0) / 2.0;
    Some(won.mean(Kind::Double).double_value(&[]))
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::agent::tests::agent;
    use crate::noise::seeded;

    #[test]
    fn evidence_is_of_the_transitions_that_were_observed() {
        let (agent, batch) = agent(&["seed=3"]);
        let mut interactions = vec![0.0_f32; 16];
        for step in [0, 4, 5, 11] {
            interactions[step] = 1.0;
        }
        let interactions = Tensor::from_slice(&interactions).view([2, 8]);
        let evidence = seeded(7, Device::Cpu, || {
            gate_evidence(agent.world(), &batch, &interactions)
        });
        let evidence = evidence.expect("there is a gate");
        // The first step of a sequence has no transition.
        assert!((evidence.interaction_share - 3.0 / 14.0).abs() < 1e-9);

        let observed = seeded(7, Device::Cpu, || {
            tch::no_grad(|| agent.world().encode(&batch.images, &batch.actions).observed)
        });
        let open = observed.gate_open.expect("there is a gate");
        let open = open.narrow(1, 1, 7).mean(Kind::Double).double_value(&[]);
        assert!((evidence.open_share - open).abs() < 1e-6);
        let kl = kl_divergence(
            &observed.noncontrollable_posterior,
            &observed.noncontrollable_prior,
        );
        let at = |sequence: i64, step: i64| kl.double_value(&[sequence, step]);
        let mean = (at(0, 4) + at(0, 5) + at(1, 3)) / 3.0;
        let surprise = evidence.surprise.expect("there are interactions");
        assert!((surprise.gated - mean).abs() < 1e-3, "{surprise:?} {mean}");
        assert!(surprise.open != surprise.shut);
    }

    #[test]
    fn without_a_gate_there_is_no_evidence() {
        let (agent, batch) = agent(&["model.dependency_gate=false"]);
        let interactions = Tensor::zeros([2, 8], (Kind::Float, Device::Cpu));
        assert_eq!(gate_evidence(agent.world(), &batch, &interactions), None);
    }

    #[test]
    fn auc_counts_pairs_in_the_right_order() {
        let scores = Tensor::from_slice(&[0.1_f32, 0.4, 0.35, 0.8]);
        let labels = |flags: &[bool]| Tensor::from_slice(flags);
        // 3 of the 4 pairs of a positive and a negative score.
        let area = auc(&scores, &labels(&[false, false, true, true]));
        assert_eq!(area, Some(0.75));
        assert_eq!(auc(&scores, &labels(&[true; 4])), None);
        let ties = Tensor::from_slice(&[1.0_f32, 1.0]);
        assert_eq!(auc(&ties, &labels(&[true, false])), Some(0.5));
    }
}
