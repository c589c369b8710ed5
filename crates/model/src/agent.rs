//! The learning agent: all networks, their optimisers, and one training step.

mod learn_behavior;
mod networks;
mod share;

use isodream_core::{Config, EnvSpec, derive_seed};
use tch::{Device, Kind, Tensor};

use self::networks::Networks;
use self::share::{Answer, Job, Phase, Share, Worker};
use crate::batch::Batch;
use crate::laps::{Laps, phase};
use crate::optimizer::Adam;
use crate::params::{LoadError, tensor_of, to_safetensors};
use crate::policy::{ActingModel, Policy};
use crate::reward::RewardModel;
use crate::world_model::WorldModel;

/// Per update, the share of the newest returns in their running range.
const RANGE_RATE: f64 = 0.02;

/// World model, actor, critic and attention with everything that training them needs.
///
/// With `learner.workers` above 1, several threads compute the gradients of an update, each for its share of the batch's
/// sequences, over one set of weights. The update is the mean of theirs; free nats are counted in each share by itself.
#[derive(Debug)]
pub struct Agent {
    share: Share,
    workers: Vec<Worker>,
    optimizers: Optimizers,
    /// Running mean of the range of imagined returns, from 0 on: `[]`.
    return_range: Tensor,
    acting_names: Vec<String>,
    config: Config,
    updates: u64,
}

#[derive(Debug)]
struct Optimizers {
    world: Adam,
    actor: Adam,
    critic: Adam,
}

/// A metric of one update; reading the tensor waits for the device.
pub type Metric = (&'static str, Tensor);

impl Agent {
    /// An untrained agent; equal seeds give equal weights.
    pub fn new(config: &Config, spec: &EnvSpec, device: Device) -> Self {
        tch::manual_seed(derive_seed(config.seed, &["agent"]) as i64);
        let action_dim = spec.action_dim as i64;
        let networks = Networks::new(config, action_dim, device);
        let params = &networks.params;
        let optimizer = &config.optimizer;
        let optimizers = Optimizers {
            world: Adam::new(&params.world, optimizer.model_lr, optimizer),
            actor: Adam::new(&params.actor, optimizer.actor_lr, optimizer),
            critic: Adam::new(&params.critic, optimizer.critic_lr, optimizer),
        };
        // A GPU is one worker by itself.
        let threads = match device {
            Device::Cpu => config.learner.workers,
            _ => 1,
        };
        Self {
            workers: (1..threads)
                .map(|_| Worker::start(&networks, config, action_dim))
                .collect(),
            share: Share::new(networks),
            optimizers,
            return_range: Tensor::zeros([], (Kind::Float, device)),
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

    /// The decoupled world model.
    pub fn world(&self) -> &WorldModel {
        &self.share.networks.world
    }

    /// Number of scalars in (world model, actor, critic with attention).
    pub fn parameter_counts(&self) -> (usize, usize, usize) {
        let params = &self.share.networks.params;
        (
            params.world.numel(),
            params.actor.numel(),
            params.critic.numel(),
        )
    }

    /// The policy over the newest weights.
    pub fn policy(&self) -> Policy<'_> {
        self.share.networks.policy()
    }

    /// One training step: representation learning, then behaviour learning.
    ///
    /// Noise is seeded by the number of the update, so that a resumed run draws what an unbroken one would.
    pub fn update(&mut self, batch: &Batch) -> Vec<Metric> {
        self.measured_update(batch, &mut Laps::off())
    }

    /// [`Self::update`] with its phases measured.
    pub fn measured_update(&mut self, batch: &Batch, laps: &mut Laps) -> Vec<Metric> {
        self.move_slow_critic();
        self.decay_learning_rates();
        let shares = batch.split(1 + self.workers.len());
        let weights: Vec<f64> = shares
            .iter()
            .map(|share| share.sequences() as f64 / batch.sequences() as f64)
            .collect();
        let world = shares.into_iter().map(Phase::World).collect();
        let Answer {
            gradients,
            mut metrics,
        } = self.compute("update", world, &weights, laps);
        let params = &self.share.networks.params;
        let norm = self.optimizers.world.step(&params.world, &gradients[0]);
        metrics.push(("train/grad_norm/model", norm));
        laps.lap(phase::WORLD_MODEL_BACKWARD);

        if self.updates >= self.config.behavior.warmup_updates {
            metrics.extend(self.learn_behavior(&weights, laps));
        }
        self.updates += 1;
        for (_, tensor) in &mut metrics {
            *tensor = tensor.detach();
        }
        metrics
    }

    /// Behaviour learning from the states of the same sequences (Alg. 1, lines 8-14).
    fn learn_behavior(&mut self, weights: &[f64], laps: &mut Laps) -> Vec<Metric> {
        let steps = self.behavior_steps(self.updates);
        let return_scale = self.return_scale(steps);
        let behavior = weights
            .iter()
            .map(|_| Phase::Behavior(return_scale.as_ref().map(Tensor::shallow_clone)))
            .collect();
        let Answer {
            gradients,
            mut metrics,
        } = self.compute("imagine", behavior, weights, laps);
        for (name, range) in &metrics {
            if *name == "train/return_range" {
                let _ = self.return_range.lerp_(range, RANGE_RATE);
            }
        }
        let params = &self.share.networks.params;
        let norm = self.optimizers.actor.step(&params.actor, &gradients[0]);
        metrics.push(("train/grad_norm/actor", norm));
        laps.lap(phase::ACTOR_BACKWARD);
        let norm = self.optimizers.critic.step(&params.critic, &gradients[1]);
        metrics.push(("train/grad_norm/critic", norm));
        laps.lap(phase::CRITIC_BACKWARD);
        metrics
    }

    /// What returns are divided by: their running range, 1 at the least. `None` where they are not divided, or where
    /// there is no range yet.
    fn return_scale(&self, steps: u64) -> Option<Tensor> {
        let normalize = self.config.behavior.normalize_returns && steps > 0;
        normalize.then(|| {
            let weight = 1.0 - (1.0 - RANGE_RATE).powi(steps.min(100_000) as i32);
            (&self.return_range / weight).clamp_min(1.0)
        })
    }

    /// Every thread does its share of a phase; the mean over all sequences.
    fn compute(
        &mut self,
        noise: &str,
        phases: Vec<Phase>,
        weights: &[f64],
        laps: &mut Laps,
    ) -> Answer {
        let update = self.updates.to_string();
        let seed =
            |share: usize| derive_seed(self.config.seed, &[noise, &update, &share.to_string()]);
        let mut jobs =
            phases
                .into_iter()
                .zip(weights)
                .enumerate()
                .map(|(share, (phase, &weight))| Job {
                    phase,
                    weight,
                    seed: seed(share),
                });
        let own = jobs.next().expect("a batch has a sequence");
        // A batch may be too small for every worker.
        let mut working = Vec::new();
        for (worker, job) in self.workers.iter().zip(jobs) {
            worker.begin(job);
            working.push(worker);
        }
        let mut sum = self.share.work(own, laps);
        for worker in working {
            sum.add(worker.finish());
        }
        sum
    }

    /// Moves the slow critic towards the critic, wholly or in part.
    fn move_slow_critic(&mut self) {
        let behavior = &self.config.behavior;
        if !self.updates.is_multiple_of(behavior.slow_critic_interval) {
            return;
        }
        let params = &self.share.networks.params;
        let slow = params.slow_critic.flat();
        let newest = params.critic.flat().narrow(0, 0, slow.numel() as i64);
        // The first time wholly, so that both begin alike.
        let fraction = if self.updates == 0 {
            1.0
        } else {
            behavior.slow_critic_fraction
        };
        let _ = tch::no_grad(|| slow.shallow_clone().lerp_(&newest, fraction));
    }

    /// Learning rates fall in a straight line over the run.
    fn decay_learning_rates(&mut self) {
        let total = self.config.total_updates().max(1) as f64;
        let gone = (self.updates as f64 / total).min(1.0);
        let factor = 1.0 - (1.0 - self.config.optimizer.final_share) * gone;
        let all = &mut self.optimizers;
        for adam in [&mut all.world, &mut all.actor, &mut all.critic] {
            adam.lr_factor = factor;
        }
    }

    /// Steps of actor and critic after so many updates.
    fn behavior_steps(&self, updates: u64) -> u64 {
        updates.saturating_sub(self.config.behavior.warmup_updates)
    }

    /// The weights that acting needs, and the reward head for those who probe the model, as safetensors bytes.
    pub fn publish(&self) -> Vec<u8> {
        let all = self.share.networks.params.all();
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
        let mut taken = 0;
        for params in self.share.networks.params.all_mut() {
            taken += params.load_where(&file, wanted)?;
        }
        Ok(taken)
    }

    /// All weights, as safetensors bytes with the names of the parameters.
    pub fn save_model(&self) -> Vec<u8> {
        let all = self.share.networks.params.all();
        let entries = all.iter().flat_map(|params| params.entries());
        to_safetensors(entries.map(|(name, tensor)| (name.as_str(), tensor)))
    }

    /// What else training goes on from, as safetensors bytes: Adam's moments, `<group>.first` and `<group>.second`, flat
    /// in the order of the group's parameters, and `return_range`.
    pub fn save_optimizer(&self) -> Vec<u8> {
        let mut tensors: Vec<(String, &Tensor)> = self
            .optimizers()
            .into_iter()
            .flat_map(|(name, adam)| {
                [
                    (format!("{name}.first"), &adam.first),
                    (format!("{name}.second"), &adam.second),
                ]
            })
            .collect();
        tensors.push((RETURN_RANGE.to_owned(), &self.return_range));
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
        let behavior_steps = self.behavior_steps(updates);
        for params in self.share.networks.params.all_mut() {
            params.load(&file)?;
        }
        let file = safetensors::SafeTensors::deserialize(optimizer)?;
        let optimizers = &mut self.optimizers;
        for (name, adam, steps) in [
            ("world_model", &mut optimizers.world, updates),
            ("actor", &mut optimizers.actor, behavior_steps),
            ("critic", &mut optimizers.critic, behavior_steps),
        ] {
            for (part, tensor) in [("first", &mut adam.first), ("second", &mut adam.second)] {
                copy_from(&file, &format!("{name}.{part}"), tensor)?;
            }
            adam.steps = steps;
        }
        copy_from(&file, RETURN_RANGE, &mut self.return_range)?;
        self.updates = updates;
        Ok(())
    }

    fn optimizers(&self) -> [(&'static str, &Adam); 3] {
        [
            ("world_model", &self.optimizers.world),
            ("actor", &self.optimizers.actor),
            ("critic", &self.optimizers.critic),
        ]
    }
}

/// Where the range of returns lies among the optimisers' moments.
const RETURN_RANGE: &str = "return_range";

fn copy_from(
    file: &safetensors::SafeTensors<'_>,
    name: &str,
    tensor: &mut Tensor,
) -> Result<(), LoadError> {
    let view = file
        .tensor(name)
        .map_err(|_| LoadError::Missing(name.to_owned()))?;
    tensor.copy_(&tensor_of(name, &view, &tensor.size())?);
    Ok(())
}

#[cfg(test)]
pub(crate) mod tests {
    use isodream_core::ImageShape;
    use isodream_core::config::Source;
    use tch::Kind;

    use super::*;

    pub(crate) fn agent(set: &[&str]) -> (Agent, Batch) {
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
        tch::manual_seed(1);
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
        let loss = agent.world().loss(&batch, &mut Laps::off());
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
    fn the_gate_opens_without_a_penalty_in_its_share_of_the_steps() {
        let losses = |share: &str| {
            // Open everywhere: no logit near the threshold, whose side rounding would decide.
            let (agent, batch) = agent(&["loss.gate_scale=1e4", "model.gate_bias=3", share]);
            crate::noise::seeded(5, Device::Cpu, || {
                let loss = agent.world().loss(&batch, &mut Laps::off());
                let (_, open) = loss
                    .terms
                    .iter()
                    .find(|(name, _)| *name == "train/loss/gate")
                    .expect("there is a gate");
                (loss.total.double_value(&[]), open.double_value(&[]))
            })
        };
        let (all, open) = losses("loss.gate_share=0");
        assert!((open - 1.0).abs() < 1e-6, "{open}");
        let (beyond, _) = losses("loss.gate_share=0.2");
        assert!((all - beyond - 2e3).abs() < 10.0, "{all} {beyond}");
        let (none, _) = losses("loss.gate_share=1");
        assert!((all - none - 1e4 * open).abs() < 10.0, "{all} {none}");
    }

    #[test]
    fn without_actions_the_variance_constraints_see_equal_outcomes() {
        let (agent, mut batch) = agent(&[]);
        batch.actions = batch.actions.zeros_like();
        let terms = agent.world().loss(&batch, &mut Laps::off()).terms;
        let term = |name: &str| {
            let (_, value) = terms.iter().find(|(n, _)| *n == name).expect("a term");
            value.double_value(&[])
        };
        assert!((term("train/loss/max_action") - 1.0).abs() < 1e-4);
        assert!(term("train/loss/min_free") < 1e-6);
    }
}
