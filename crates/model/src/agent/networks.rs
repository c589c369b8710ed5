//! All networks of an agent with their parameters.

use isodream_core::Config;
use tch::{Device, Tensor};

use crate::attention::FutureAttention;
use crate::behavior::Critic;
use crate::params::Params;
use crate::policy::{Actor, Future, Policy, attends};
use crate::precision::product_kind;
use crate::world_model::WorldModel;

/// World model, actor, critic and attention.
#[derive(Debug)]
pub(super) struct Networks {
    pub(super) world: WorldModel,
    pub(super) actor: Actor,
    pub(super) critic: Critic,
    pub(super) slow_critic: Critic,
    pub(super) attention: Option<FutureAttention>,
    pub(super) params: Groups,
    pub(super) config: Config,
}

/// The parameters by optimiser. The critic's group holds the attention as well; the slow critic has no optimiser.
#[derive(Debug)]
pub(super) struct Groups {
    pub(super) world: Params,
    pub(super) actor: Params,
    pub(super) critic: Params,
    pub(super) slow_critic: Params,
}

impl Groups {
    pub(super) fn all(&self) -> [&Params; 4] {
        [&self.world, &self.actor, &self.critic, &self.slow_critic]
    }

    pub(super) fn all_mut(&mut self) -> [&mut Params; 4] {
        [
            &mut self.world,
            &mut self.actor,
            &mut self.critic,
            &mut self.slow_critic,
        ]
    }
}

impl Networks {
    /// Networks with random weights from libtorch's generator.
    pub(super) fn new(config: &Config, action_dim: i64, device: Device) -> Self {
        let products = product_kind(config.learner.precision, device);
        let group = || Params::multiplied_in(products, device);
        let (mut world_params, mut actor_params) = (group(), group());
        let (mut critic_params, mut slow_params) = (group(), group());
        let world = WorldModel::new(world_params.root("world_model"), config, action_dim);
        let actor = Actor::new(actor_params.root("actor"), config, action_dim);
        let critic = Critic::new(critic_params.root("critic"), config);
        let attention = attends(config)
            .then(|| FutureAttention::new(critic_params.root("attention"), &config.model));
        let slow_critic = Critic::new(slow_params.root("slow_critic"), config);
        let mut params = Groups {
            world: world_params,
            actor: actor_params,
            critic: critic_params,
            slow_critic: slow_params,
        };
        for group in params.all_mut() {
            group.flatten();
        }
        Self {
            world,
            actor,
            critic,
            slow_critic,
            attention,
            params,
            config: config.clone(),
        }
    }

    /// The same networks over the memory of others, which `memory` gives group by group: a change of one is a change of
    /// both.
    pub(super) fn over(
        memory: [Tensor; 4],
        config: &Config,
        action_dim: i64,
        device: Device,
    ) -> Self {
        let mut networks = Self::new(config, action_dim, device);
        for (group, memory) in networks.params.all_mut().into_iter().zip(memory) {
            group.adopt(memory);
        }
        networks
    }

    /// The memory of all groups, for [`Self::over`].
    pub(super) fn memory(&self) -> [Tensor; 4] {
        self.params.all().map(|group| group.flat().shallow_clone())
    }

    pub(super) fn policy(&self) -> Policy<'_> {
        Policy {
            rssm: &self.world.rssm,
            future: Future::of(&self.config, self.attention.as_ref()),
            actor: &self.actor,
            indicator: self.config.model.indicator,
            window: self.config.behavior.rollout_window,
        }
    }
}
