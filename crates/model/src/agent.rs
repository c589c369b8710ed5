//! The learning agent: all networks, their optimisers, and one training step.

mod learn_behavior;

use isodream_core::{Config, EnvSpec, derive_seed};
use tch::{Device, Tensor};

use crate::attention::FutureAttention;
use crate::batch::Batch;
use crate::behavior::Critic;
use crate::laps::{Laps, phase};
use crate::optimizer::Adam;
use crate::params::{LoadError, Params, tensor_of, to_safetensors};
use crate::policy::{ActingModel, Actor, Future, Policy, attends};
use crate::precision::product_kind;
use crate::reward::RewardModel;
use crate::world_model::WorldModel;

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
        let actor = Actor::new(actor_params.root("actor"), config, action_dim);
        actor_params.flatten();
        let mut critic_params = group();
        let critic = Critic::new(critic_params.root("critic"), config);
        let attention =
            attends(config).then(|| FutureAttention::new(critic_params.root("attention"), model));
        critic_params.flatten();
        let mut slow_params = group();
        let slow_critic = Critic::new(slow_params.root("slow_critic"), config);
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
            future: Future::of(&self.config, self.attention.as_ref()),
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

    /// The weights that acting needs, and the reward head for those who probe the model, as safetensors bytes.
    pub fn publish(&self) -> Vec<u8> {
        let groups = &self.groups;
        let all = [&groups.world.0, &groups.actor.0, &groups.critic.0];
        let entries = all.iter().flat_map(|params| params.entries());
        to_safetensors(
            entries
                .filter(|(name, _)| self.acting_names.contains(name) || RewardModel::holds(name))
                .map(|(name, tensor)| (name.as_str(), tensor)),
        )
    }

    /// Takes over weights of another agent, for transfer: those with one of the words `parts` in their name, or all.
    /// Moments and counters stay at their beginning. Returns how many tensors were taken.
    ///
    /// # Errors
    /// [`LoadError`] where such a tensor is missing or of another shape.
    pub fn transfer(&mut self, model: &[u8], parts: &[String]) -> Result<usize, LoadError> {
        let file = safetensors::SafeTensors::deserialize(model)?;
        let wanted = |name: &str| {
            let mut words = name.split('.');
            parts.is_empty() || words.any(|word| parts.iter().any(|part| part == word))
        };
        let groups = &mut self.groups;
        let mut taken = 0;
        for params in [
            &mut groups.world.0,
            &mut groups.actor.0,
            &mut groups.critic.0,
            &mut groups.slow_critic,
        ] {
            taken += params.load_where(&file, wanted)?;
        }
        Ok(taken)
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
    use tch::Kind;

    use super::*;

    pub(super) fn agent(set: &[&str]) -> (Agent, Batch) {
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
