//! The learning agent: all networks, their optimisers, and one training step.

use isodream_core::{Config, EnvSpec, derive_seed};
use tch::{Device, Kind, Tensor};

use crate::attention::FutureAttention;
use crate::batch::Batch;
use crate::behavior::{
    Critic, actor_loss, critic_loss, imagine, lambda_return, starts, step_weights,
};
use crate::chunked::add_gradients;
use crate::laps::{Laps, phase};
use crate::optimizer::Adam;
use crate::params::{LoadError, Params, tensor_of, to_safetensors};
use crate::policy::{ActingModel, Actor, Policy, looks_ahead};
use crate::precision::product_kind;
use crate::rssm::State;
use crate::world_model::WorldModel;

/// Starts from which is imagined at a time: more need more memory and are no faster.
const IMAGINED_STARTS: i64 = 512;

/// World model, actor, critic and attention with everything that training them needs.
#[derive(Debug)]
pub struct Agent {
    /// The decoupled world model.
    pub world: WorldModel,
    actor: Actor,
    critic: Critic,
    slow_critic: Critic,
    attention: Option<FutureAttention>,
    groups: Groups,
    acting_names: Vec<String>,
    config: Config,
    updates: u64,
}

#[derive(Debug)]
struct Groups {
    world: (Params, Adam),
    actor: (Params, Adam),
    critic: (Params, Adam),
    slow_critic: Params,
}

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

/// A metric of one update; reading the tensor waits for the device.
pub type Metric = (&'static str, Tensor);

impl Agent {
    /// An untrained agent; equal seeds give equal weights.
    pub fn new(config: &Config, spec: &EnvSpec, device: Device) -> Self {
        tch::manual_seed(derive_seed(config.seed, &["agent"]) as i64);
        let action_dim = spec.action_dim as i64;
        let model = &config.model;

        let products = product_kind(config.learner.precision, device);
        let group = || Params::multiplied_in(products, device);
        let mut world_params = group();
        let world = WorldModel::new(world_params.root("world_model"), config, action_dim);
        world_params.flatten();
        let mut actor_params = group();
        let actor = Actor::new(actor_params.root("actor"), model, action_dim);
        actor_params.flatten();
        let mut critic_params = group();
        let critic = Critic::new(critic_params.root("critic"), model);
        let attention = looks_ahead(config)
            .then(|| FutureAttention::new(critic_params.root("attention"), model));
        critic_params.flatten();
        let mut slow_params = group();
        let slow_critic = Critic::new(slow_params.root("slow_critic"), model);
        slow_params.flatten();

        let optimizer = &config.optimizer;
        let with_adam = |params: Params, lr: f64| {
            let adam = Adam::new(&params, lr, optimizer);
            (params, adam)
        };
        Self {
            world,
            actor,
            critic,
            slow_critic,
            attention,
            groups: Groups {
                world: with_adam(world_params, optimizer.model_lr),
                actor: with_adam(actor_params, optimizer.actor_lr),
                critic: with_adam(critic_params, optimizer.critic_lr),
                slow_critic: slow_params,
            },
            acting_names: ActingModel::new(config, spec.action_dim, Device::Cpu)
                .names()
                .map(str::to_owned)
                .collect(),
            config: config.clone(),
            updates: 0,
        }
    }

    /// Training steps made.
    pub fn updates(&self) -> u64 {
        self.updates
    }

    /// Number of scalars in (world model, actor, critic with attention).
    pub fn parameter_counts(&self) -> (usize, usize, usize) {
        let groups = &self.groups;
        (
            groups.world.0.numel(),
            groups.actor.0.numel(),
            groups.critic.0.numel(),
        )
    }

    /// The policy over the newest weights.
    pub fn policy(&self) -> Policy<'_> {
        Policy {
            rssm: &self.world.rssm,
            attention: self.attention.as_ref(),
            actor: &self.actor,
            indicator: self.config.model.indicator,
            window: self.config.behavior.rollout_window,
        }
    }

    /// One training step: representation learning, then behaviour learning.
    ///
    /// Noise is seeded by the number of the update, so that a resumed run draws what an unbroken one would.
    pub fn update(&mut self, batch: &Batch) -> Vec<Metric> {
        self.measured_update(batch, &mut Laps::off())
    }

    /// [`Self::update`] with its phases measured.
    pub fn measured_update(&mut self, batch: &Batch, laps: &mut Laps) -> Vec<Metric> {
        let seed = derive_seed(self.config.seed, &["update", &self.updates.to_string()]);
        tch::manual_seed(seed as i64);
        if self
            .updates
            .is_multiple_of(self.config.behavior.slow_critic_interval)
        {
            let Groups {
                critic,
                slow_critic,
                ..
            } = &mut self.groups;
            let values = critic.0.flat().narrow(0, 0, slow_critic.numel() as i64);
            tch::no_grad(|| slow_critic.flat().shallow_clone().copy_(&values));
        }

        let model = self.world.loss(batch, laps);
        let mut metrics = model.terms;
        let (params, adam) = &mut self.groups.world;
        metrics.push(("train/grad_norm/model", adam.minimize(&model.total, params)));
        laps.lap(phase::WORLD_MODEL_BACKWARD);

        if self.updates >= self.config.behavior.warmup_updates {
            metrics.extend(self.learn_behavior(&model.states, laps));
        }
        self.updates += 1;
        for (_, tensor) in &mut metrics {
            *tensor = tensor.detach();
        }
        metrics
    }

    /// Behaviour learning from the given posterior states (Alg. 1, lines 8-14).
    fn learn_behavior(&mut self, states: &State, laps: &mut Laps) -> Vec<Metric> {
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

    /// The weights that acting needs, as safetensors bytes.
    pub fn publish(&self) -> Vec<u8> {
        let groups = &self.groups;
        let all = [&groups.world.0, &groups.actor.0, &groups.critic.0];
        let entries = all.iter().flat_map(|params| params.entries());
        to_safetensors(
            entries
                .filter(|(name, _)| self.acting_names.contains(name))
                .map(|(name, tensor)| (name.as_str(), tensor)),
        )
    }

    /// All weights, as safetensors bytes with the names of the parameters.
    pub fn save_model(&self) -> Vec<u8> {
        let groups = &self.groups;
        let all = [
            &groups.world.0,
            &groups.actor.0,
            &groups.critic.0,
            &groups.slow_critic,
        ];
        let entries = all.iter().flat_map(|params| params.entries());
        to_safetensors(entries.map(|(name, tensor)| (name.as_str(), tensor)))
    }

    /// Adam's moments, as safetensors bytes: `<group>.first` and `<group>.second`, flat in the order of the
    /// group's parameters.
    pub fn save_optimizer(&self) -> Vec<u8> {
        let tensors: Vec<(String, &Tensor)> = self
            .optimizers()
            .into_iter()
            .flat_map(|(name, adam)| {
                [
                    (format!("{name}.first"), &adam.first),
                    (format!("{name}.second"), &adam.second),
                ]
            })
            .collect();
        to_safetensors(
            tensors
                .iter()
                .map(|(name, tensor)| (name.as_str(), *tensor)),
        )
    }

    /// Takes weights, moments and the update counter of a checkpoint. Each update moves every optimiser by
    /// one step, actor and critic from the end of the warm-up on, so that the counter serves them all.
    ///
    /// # Errors
    /// [`LoadError`] where the bytes are damaged or of another model.
    pub fn load(&mut self, model: &[u8], optimizer: &[u8], updates: u64) -> Result<(), LoadError> {
        let file = safetensors::SafeTensors::deserialize(model)?;
        let behavior_steps = updates.saturating_sub(self.config.behavior.warmup_updates);
        let groups = &mut self.groups;
        for params in [
            &mut groups.world.0,
            &mut groups.actor.0,
            &mut groups.critic.0,
            &mut groups.slow_critic,
        ] {
            params.load(&file)?;
        }
        let file = safetensors::SafeTensors::deserialize(optimizer)?;
        for (name, adam, steps) in [
            ("world_model", &mut groups.world.1, updates),
            ("actor", &mut groups.actor.1, behavior_steps),
            ("critic", &mut groups.critic.1, behavior_steps),
        ] {
            for (part, tensor) in [("first", &mut adam.first), ("second", &mut adam.second)] {
                let name = format!("{name}.{part}");
                let view = file
                    .tensor(&name)
                    .map_err(|_| LoadError::Missing(name.clone()))?;
                tensor.copy_(&tensor_of(&name, &view, &tensor.size())?);
            }
            adam.steps = steps;
        }
        self.updates = updates;
        Ok(())
    }

    fn optimizers(&self) -> [(&'static str, &Adam); 3] {
        [
            ("world_model", &self.groups.world.1),
            ("actor", &self.groups.actor.1),
            ("critic", &self.groups.critic.1),
        ]
    }
}

#[cfg(test)]
mod tests {
    use isodream_core::ImageShape;
    use isodream_core::config::Source;

    use super::*;

    fn agent(set: &[&str]) -> (Agent, Batch) {
        let config = Config::load(&Source {
            preset: Some("debug".into()),
            file: None,
            set: set.iter().map(|s| (*s).to_owned()).collect(),
        })
        .expect("a valid configuration");
        let spec = EnvSpec {
            id: "test".into(),
            image: ImageShape {
                height: 64,
                width: 64,
                channels: 3,
            },
            action_dim: 2,
            action_repeat: 1,
            time_limit: 50,
        };
        let float = (Kind::Float, Device::Cpu);
        let actions = Tensor::rand([2, 8, 2], float) * 2.0 - 1.0;
        let batch = Batch {
            images: Tensor::rand([2, 8, 3, 64, 64], float) - 0.5,
            rewards: actions.select(2, 0),
            discounts: Tensor::ones([2, 8], float),
            actions,
        };
        (Agent::new(&config, &spec, Device::Cpu), batch)
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

    #[test]
    fn the_world_loss_is_the_weighted_sum_of_its_terms() {
        let (agent, batch) = agent(&[
            "loss.reward_scale=3",
            "loss.action_scale=5",
            "loss.controllable_kl_scale=7",
            "loss.noncontrollable_kl_scale=11",
            "loss.max_action_scale=13",
            "loss.min_free_scale=17",
            "loss.gate_scale=19",
            "loss.discount_scale=23",
            "model.discount_head=true",
        ]);
        let loss = agent.world.loss(&batch, &mut Laps::off());
        let term = |name: &str| {
            let (_, value) = loss
                .terms
                .iter()
                .find(|(n, _)| n.strip_prefix("train/loss/") == Some(name))
                .unwrap_or_else(|| panic!("no term {name}"));
            value.double_value(&[])
        };
        let sum = term("image")
            + 3.0 * term("reward")
            + 5.0 * term("action")
            + 7.0 * term("controllable_kl")
            + 11.0 * term("noncontrollable_kl")
            + 13.0 * term("max_action")
            + 17.0 * term("min_free")
            + 19.0 * term("gate")
            + 23.0 * term("discount");
        let total = loss.total.double_value(&[]);
        assert!((total - sum).abs() < 1e-5 * total.abs(), "{total} {sum}");
    }

    #[test]
    fn without_actions_the_variance_constraints_see_equal_outcomes() {
        let (agent, mut batch) = agent(&[]);
        batch.actions = batch.actions.zeros_like();
        let terms = agent.world.loss(&batch, &mut Laps::off()).terms;
        let term = |name: &str| {
            let (_, value) = terms.iter().find(|(n, _)| *n == name).expect("a term");
            value.double_value(&[])
        };
        assert!((term("train/loss/max_action") - 1.0).abs() < 1e-4);
        assert!(term("train/loss/min_free") < 1e-6);
    }
}
