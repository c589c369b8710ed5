//! Behaviour learning: a step of actor, critic and attention (Iso-Dream++ Alg. 1, lines 8-14).

use tch::{Kind, Tensor};

use super::{Agent, Metric};
use crate::behavior::{actor_loss, critic_loss, imagine, lambda_return, starts, step_weights};
use crate::chunked::add_gradients;
use crate::laps::{Laps, phase};
use crate::params::Params;
use crate::rssm::State;

/// Starts from which is imagined at a time: more need more memory and are no faster.
const IMAGINED_STARTS: i64 = 512;

/// The losses of trajectories from some of the starts, each a mean over them.
struct BehaviorLosses {
    actor: Tensor,
    critic: Tensor,
    metrics: Vec<Metric>,
}

/// What a step of actor and critic needs, one gradient per parameter.
#[derive(Default)]
struct BehaviorGradients {
    actor: Vec<Tensor>,
    critic: Vec<Tensor>,
    metrics: Vec<Metric>,
}

impl Agent {
    /// Behaviour learning from the given posterior states (Alg. 1, lines 8-14).
    pub(super) fn learn_behavior(&mut self, states: &State, laps: &mut Laps) -> Vec<Metric> {
        let starts = starts(states, &self.config);
        let BehaviorGradients {
            actor,
            critic,
            mut metrics,
        } = self.behavior_gradients(&starts, IMAGINED_STARTS, laps);
        let (params, adam) = &mut self.groups.actor;
        metrics.push(("train/grad_norm/actor", adam.step(params, &actor)));
        laps.lap(phase::ACTOR_BACKWARD);
        let (params, adam) = &mut self.groups.critic;
        metrics.push(("train/grad_norm/critic", adam.step(params, &critic)));
        laps.lap(phase::CRITIC_BACKWARD);
        metrics
    }

    /// Gradients of both losses, `rows` starts after the others: the losses are means over starts, and the graph of
    /// their trajectories would be most of the memory.
    fn behavior_gradients(&self, starts: &State, rows: i64, laps: &mut Laps) -> BehaviorGradients {
        let total = starts.controllable.stoch.size()[0];
        let mut sums = BehaviorGradients::default();
        let mut first = 0;
        while first < total {
            let count = rows.min(total - first);
            let share = count as f64 / total as f64;
            let losses = self.behavior_losses(starts.map(|x| x.narrow(0, first, count)), laps);
            let gradients = |loss: &Tensor, params: &Params, keep_graph: bool| {
                Tensor::run_backward(&[loss * share], &params.tensors(), keep_graph, false)
            };
            let actor = gradients(&losses.actor, &self.groups.actor.0, true);
            add_gradients(&mut sums.actor, actor);
            laps.lap(phase::ACTOR_BACKWARD);
            let critic = gradients(&losses.critic, &self.groups.critic.0, false);
            add_gradients(&mut sums.critic, critic);
            laps.lap(phase::CRITIC_BACKWARD);
            for (index, (name, value)) in losses.metrics.into_iter().enumerate() {
                let value = value.detach() * share;
                match sums.metrics.get_mut(index) {
                    Some((_, sum)) => *sum += value,
                    None => sums.metrics.push((name, value)),
                }
            }
            first += count;
        }
        sums
    }

    /// Imagines from `starts`, and both losses of it.
    fn behavior_losses(&self, starts: State, laps: &mut Laps) -> BehaviorLosses {
        let config = &self.config.behavior;
        let imagined = imagine(&self.world, &self.policy(), starts, config);
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
        let actor = actor_loss(
            &returns,
            &imagined.entropies,
            &weights,
            config.entropy_scale,
        );
        // Its loss reaches the critic and, through `e_t`, the attention; only their gradients are asked for.
        let steps = config.imagination_horizon - 1;
        let values = self.critic.forward(&imagined.feats.narrow(0, 0, steps));
        let critic = critic_loss(&values, &returns, &weights);
        let metrics = vec![
            ("train/imagined_reward", imagined.rewards.mean(Kind::Float)),
            ("train/imagined_return", returns.mean(Kind::Float)),
            ("train/value", values.mean(Kind::Float)),
            ("train/actor_entropy", imagined.entropies.mean(Kind::Float)),
            (
                "train/action_magnitude",
                imagined.actions.abs().mean(Kind::Float),
            ),
            ("train/loss/actor", actor.shallow_clone()),
            ("train/loss/critic", critic.shallow_clone()),
        ];
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
    use super::super::tests::agent;
    use super::*;

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
    fn starts_after_others_have_the_gradients_of_all() {
        let (agent, batch) = agent(&[]);
        let states = agent.world.loss(&batch, &mut Laps::off()).states;
        let starts = starts(&states, &agent.config);
        assert_eq!(starts.controllable.stoch.size()[0], 16);
        tch::manual_seed(5);
        let parts = agent.behavior_gradients(&starts, 12, &mut Laps::off());
        // The same noise again: of both parts by themselves, weighted by their starts.
        tch::manual_seed(5);
        let [many, few] = [(0, 12), (12, 4)].map(|(first, count)| {
            let part = starts.map(|x| x.narrow(0, first, count));
            agent.behavior_gradients(&part, count, &mut Laps::off())
        });
        let mean = |a: &Tensor, b: &Tensor| a * 0.75 + b * 0.25;
        let pairs = [
            (&parts.actor, &many.actor, &few.actor),
            (&parts.critic, &many.critic, &few.critic),
        ];
        for (sum, a, b) in pairs {
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
        let states = agent.world.loss(&batch, &mut Laps::off()).states;
        let imagined = imagine(
            &agent.world,
            &agent.policy(),
            starts(&states, &agent.config),
            &agent.config.behavior,
        );
        let groups = &agent.groups;
        let memory = agent
            .policy()
            .look_ahead(&starts(&states, &agent.config))
            .memory;
        assert!(
            !memory.expect("the policy looks ahead").requires_grad(),
            "noncontrollable futures are cut from the graph"
        );

        // The start's reward owes nothing to imagined actions, every later one does.
        let reward = |t: i64| imagined.rewards.get(t).sum(Kind::Float);
        assert_eq!(reach(&reward(0), &groups.actor.0, "actor"), 0.0);
        assert!(reach(&reward(1), &groups.actor.0, "actor") > 0.0);

        let value = agent.slow_critic.forward(&imagined.feats).sum(Kind::Float);
        assert!(
            reach(&value, &groups.actor.0, "actor") > 0.0,
            "the value's gradient passes e_t"
        );

        let values = agent.critic.forward(&imagined.feats).sum(Kind::Float);
        assert!(reach(&values, &groups.critic.0, "critic") > 0.0);
        assert!(
            reach(&values, &groups.critic.0, "attention") > 0.0,
            "attention learns from the critic's loss"
        );
        // Nor does that gradient take the way of earlier actions: it is the one of `e_t` from inputs cut from
        // the graph.
        let actions = imagined.actions.sum(Kind::Float);
        assert!(reach(&actions, &groups.actor.0, "actor") > 0.0);
        assert_eq!(reach(&actions, &groups.critic.0, "attention"), 0.0);
    }
}
