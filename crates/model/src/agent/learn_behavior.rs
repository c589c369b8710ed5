//! Behaviour learning: the gradients of actor, critic and attention (Iso-Dream++ Alg. 1, lines 8-14).

use tch::{Kind, Tensor};

use super::Metric;
use super::networks::Networks;
use super::share::{Answer, add_metrics};
use crate::behavior::{
    Replayed, Starts, actor_loss, critic_loss, imagine, lambda_return, replayed_returns,
    return_range, starts, step_weights,
};
use crate::chunked::add_gradients;
use crate::laps::{Laps, phase};
use crate::params::Params;

/// Starts from which is imagined at a time: more need more memory and are no faster.
const IMAGINED_STARTS: i64 = 512;

/// The losses of trajectories from some of the starts, each a mean over them.
struct BehaviorLosses {
    actor: Tensor,
    critic: Tensor,
    metrics: Vec<Metric>,
}

impl Networks {
    /// Gradients of `weight` times the actor's and the critic's loss from replayed sequences, returns divided by
    /// `return_scale`.
    pub(super) fn behavior_gradients(
        &self,
        replayed: &Replayed,
        return_scale: Option<&Tensor>,
        weight: f64,
        laps: &mut Laps,
    ) -> Answer {
        let starts = starts(replayed, &self.config);
        self.gradients_in_parts(&starts, return_scale, weight, IMAGINED_STARTS, laps)
    }

    /// Gradients of both losses, `rows` starts after the others: the losses are means over starts, and the graph of
    /// their trajectories would be most of the memory.
    fn gradients_in_parts(
        &self,
        starts: &Starts,
        return_scale: Option<&Tensor>,
        weight: f64,
        rows: i64,
        laps: &mut Laps,
    ) -> Answer {
        let (mut actor, mut critic, mut metrics) = (Vec::new(), Vec::new(), Vec::new());
        for part in starts.parts(rows) {
            let share = weight * part.rows() as f64 / starts.rows() as f64;
            let losses = self.behavior_losses(part, return_scale, laps);
            let gradients = |loss: &Tensor, params: &Params, keep_graph: bool| {
                Tensor::run_backward(&[loss * share], &params.tensors(), keep_graph, false)
            };
            let of_actor = gradients(&losses.actor, &self.params.actor, true);
            add_gradients(&mut actor, of_actor);
            laps.lap(phase::ACTOR_BACKWARD);
            let of_critic = gradients(&losses.critic, &self.params.critic, false);
            add_gradients(&mut critic, of_critic);
            laps.lap(phase::CRITIC_BACKWARD);
            add_metrics(&mut metrics, losses.metrics, share);
        }
        Answer {
            gradients: vec![actor, critic],
            metrics,
        }
    }

    /// Imagines from `starts`, and both losses of it.
    fn behavior_losses(
        &self,
        starts: Starts,
        return_scale: Option<&Tensor>,
        laps: &mut Laps,
    ) -> BehaviorLosses {
        let config = &self.config.behavior;
        let imagined = imagine(&self.world, &self.policy(), starts.states, config);
        laps.lap(phase::IMAGINE);
        let value_feats = if config.value_gradient {
            imagined.feats.shallow_clone()
        } else {
            imagined.feats.detach()
        };
        let slow_values = self.slow_critic.forward(&value_feats);
        let returns = lambda_return(
            &imagined.rewards,
            &slow_values,
            &imagined.discounts,
            config.lambda,
        );
        let weights = step_weights(&imagined.discounts);
        let range = return_range(&returns);
        let own_scale = range.clamp_min(1.0);
        let scaled = match return_scale {
            Some(scale) => &returns / scale,
            None if config.normalize_returns => &returns / own_scale,
            None => returns.shallow_clone(),
        };
        let actor = actor_loss(&scaled, &imagined.entropies, &weights, config.entropy_scale)
            + (&weights * &imagined.saturations).mean(Kind::Float) * config.mean_penalty;
        // Its loss reaches the critic and, through `e_t`, the attention; only their gradients are asked for.
        let steps = config.imagination_horizon - 1;
        let values = self.critic.forward(&imagined.feats.narrow(0, 0, steps));
        let mut critic = critic_loss(&values, &returns, &weights);
        let mut metrics = Vec::new();
        if let Some(had) = &starts.had {
            let returns = replayed_returns(&returns.get(0), had, config);
            let values =
                (values.get(0).view_as(&had.0).transpose(0, 1)).narrow(0, 0, returns.size()[0]);
            let replay = critic_loss(&values, &returns, &returns.ones_like());
            critic += &replay * config.replay_value_scale;
            metrics.push(("train/replayed_return", returns.mean(Kind::Float)));
            metrics.push(("train/loss/replay_value", replay));
        }
        metrics.extend([
            ("train/imagined_reward", imagined.rewards.mean(Kind::Float)),
            ("train/imagined_return", returns.mean(Kind::Float)),
            ("train/return_range", range),
            ("train/value", values.mean(Kind::Float)),
            ("train/actor_entropy", imagined.entropies.mean(Kind::Float)),
            (
                "train/actor_saturation",
                imagined.saturations.mean(Kind::Float),
            ),
            (
                "train/action_magnitude",
                imagined.actions.abs().mean(Kind::Float),
            ),
            ("train/loss/actor", actor.shallow_clone()),
            ("train/loss/critic", critic.shallow_clone()),
        ]);
        laps.lap(phase::VALUES);
        BehaviorLosses {
            actor,
            critic,
            metrics,
        }
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::super::Agent;
    use super::super::tests::agent;
    use super::*;
    use crate::batch::Batch;
    use crate::noise::seeded;

    fn replayed(agent: &Agent, batch: &Batch) -> Replayed {
        Replayed {
            states: agent.world().loss(batch, &mut Laps::off()).states,
            rewards: batch.rewards.shallow_clone(),
            discounts: batch.discounts.shallow_clone(),
        }
    }

    /// Sum of the norms of a loss's gradients with respect to the parameters under `prefix`.
    fn reach(loss: &Tensor, params: &Params, prefix: &str) -> f64 {
        let inputs: Vec<&Tensor> = params
            .entries()
            .iter()
            .filter(|(name, _)| name.starts_with(prefix))
            .map(|(_, tensor)| tensor)
            .collect();
        assert!(!inputs.is_empty(), "no parameter under {prefix}");
        Tensor::run_backward(&[loss], &inputs, true, false)
            .iter()
            .filter(|gradient| gradient.defined())
            .map(|gradient| gradient.norm().double_value(&[]))
            .sum()
    }

    #[test]
    fn the_actors_gradient_counts_more_where_imagination_starts() {
        // Two states: the only action is that of the start.
        let (mut agent, batch) = agent(&["behavior.imagination_horizon=2"]);
        let replayed = replayed(&agent, &batch);
        let [once, thrice] = [1.0, 3.0].map(|weight| {
            let networks = &mut agent.share.networks;
            networks.config.behavior.start_weight = weight;
            seeded(5, Device::Cpu, || {
                networks.behavior_gradients(&replayed, None, 1.0, &mut Laps::off())
            })
            .gradients
        });
        let sum: f64 = (once[0].iter())
            .map(|gradient| gradient.norm().double_value(&[]))
            .sum();
        assert!(sum > 1e-4, "there is a gradient to count: {sum}");
        for (group, times) in [3.0, 1.0].into_iter().enumerate() {
            for (a, b) in once[group].iter().zip(&thrice[group]) {
                assert_eq!(a.defined(), b.defined());
                assert!(!a.defined() || (a * times).allclose(b, 1e-3, 1e-7, false));
            }
        }
    }

    #[test]
    fn starts_after_others_have_the_gradients_of_all() {
        let (agent, batch) = agent(&[]);
        let networks = &agent.share.networks;
        let starts = starts(&replayed(&agent, &batch), &agent.config);
        assert_eq!(starts.rows(), 16);
        let scale = Some(Tensor::from(2.0_f32));
        let gradients = |starts: &Starts, rows: i64| {
            networks.gradients_in_parts(starts, scale.as_ref(), 1.0, rows, &mut Laps::off())
        };
        let parts = seeded(5, Device::Cpu, || gradients(&starts, 12));
        // The same noise again: of both parts by themselves, weighted by their starts.
        let both: [Starts; 2] = starts.parts(12).try_into().expect("two parts");
        assert_eq!([12, 4], both.each_ref().map(Starts::rows));
        let [many, few] = seeded(5, Device::Cpu, || {
            both.map(|part| gradients(&part, part.rows()))
        });
        let mean = |a: &Tensor, b: &Tensor| a * 0.75 + b * 0.25;
        let groups = parts
            .gradients
            .iter()
            .zip(&many.gradients)
            .zip(&few.gradients);
        for ((sum, a), b) in groups {
            for index in 0..sum.len() {
                assert_eq!(sum[index].defined(), a[index].defined());
                if sum[index].defined() {
                    let wanted = mean(&a[index], &b[index]);
                    assert!(sum[index].allclose(&wanted, 1e-4, 1e-7, false), "{index}");
                }
            }
        }
        for ((name, sum), ((_, a), (_, b))) in parts
            .metrics
            .iter()
            .zip(many.metrics.iter().zip(&few.metrics))
        {
            assert!(sum.allclose(&mean(a, b), 1e-4, 1e-6, false), "{name}");
        }
    }

    #[test]
    fn gradients_of_behaviour_learning_go_where_they_should() {
        let (agent, batch) = agent(&[]);
        let replayed = replayed(&agent, &batch);
        let imagined = imagine(
            agent.world(),
            &agent.policy(),
            starts(&replayed, &agent.config).states,
            &agent.config.behavior,
        );
        let networks = &agent.share.networks;
        let groups = &networks.params;
        let memory = agent
            .policy()
            .look_ahead(&starts(&replayed, &agent.config).states)
            .memory;
        assert!(
            !memory.expect("the policy looks ahead").requires_grad(),
            "noncontrollable futures are cut from the graph"
        );

        // The start's reward owes nothing to imagined actions, every later one does.
        let reward = |t: i64| imagined.rewards.get(t).sum(Kind::Float);
        assert_eq!(reach(&reward(0), &groups.actor, "actor"), 0.0);
        assert!(reach(&reward(1), &groups.actor, "actor") > 0.0);

        let value = networks
            .slow_critic
            .forward(&imagined.feats)
            .sum(Kind::Float);
        assert!(
            reach(&value, &groups.actor, "actor") > 0.0,
            "the value's gradient passes e_t"
        );

        let values = networks.critic.forward(&imagined.feats).sum(Kind::Float);
        assert!(reach(&values, &groups.critic, "critic") > 0.0);
        assert!(
            reach(&values, &groups.critic, "attention") > 0.0,
            "attention learns from the critic's loss"
        );
        // Nor does that gradient take the way of earlier actions: it is the one of `e_t` from inputs cut from
        // the graph.
        let actions = imagined.actions.sum(Kind::Float);
        assert!(reach(&actions, &groups.actor, "actor") > 0.0);
        assert_eq!(reach(&actions, &groups.critic, "attention"), 0.0);
    }
}
