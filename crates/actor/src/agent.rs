//! Published weights acting on a vector of environments.

use isodream_core::{Config, EnvSpec, Step, Steps};
use isodream_model::batch::{StagedSteps, preprocess};
use isodream_model::policy::Memory;
use isodream_model::reward::{Plans, imagined_returns};
use isodream_model::{ActingModel, Actions, Decision, LoadError, RewardModel};
use tch::{Device, Tensor};

/// What one decision was made of.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Insight {
    /// Weights over the rollout window, which sum to 1 (Eq. 13); empty where the policy does not look ahead.
    pub attention: Vec<f32>,
    /// Opening of the dependency gate, 0 or 1 (Eq. 11); none without a gate.
    pub gate: Option<f32>,
}

/// A policy with its recurrent memory over a vector of environments.
#[derive(Debug)]
pub struct AgentPolicy {
    model: ActingModel,
    memory: Memory,
    spec: EnvSpec,
}

impl AgentPolicy {
    /// A policy from safetensors bytes, published or of a checkpoint.
    ///
    /// # Errors
    /// [`LoadError`] where the weights are damaged or of another model.
    pub fn new(
        config: &Config,
        spec: &EnvSpec,
        environments: usize,
        weights: &[u8],
    ) -> Result<Self, LoadError> {
        let mut model = ActingModel::new(config, spec.action_dim, Device::Cpu);
        model.load(weights)?;
        let memory = model.begin(environments as i64);
        Ok(Self {
            model,
            memory,
            spec: spec.clone(),
        })
    }

    /// Takes newer weights and keeps the memory, so that weights may change in the middle of an episode.
    ///
    /// # Errors
    /// [`LoadError`]; the old weights stay then.
    pub fn load(&mut self, weights: &[u8]) -> Result<(), LoadError> {
        self.model.load(weights)
    }

    /// One action per environment, from the newest step of each and taken as each is told.
    pub fn act(&mut self, steps: &[&Step], how: &[Actions]) -> Vec<Vec<f32>> {
        let decision = self.decide(steps);
        // Noise is drawn only where somebody asks for it.
        let drawn = how.contains(&Actions::Sample);
        let samples = drawn.then(|| decision.actions(Actions::Sample));
        let modes = decision.actions(Actions::Mode);
        let rows = how.iter().enumerate();
        rows.map(|(row, how)| {
            let all = match (how, &samples) {
                (Actions::Sample, Some(samples)) => samples,
                _ => &modes,
            };
            values(&all.get(row as i64))
        })
        .collect()
    }

    /// The action of the only environment, and what it was made of.
    ///
    /// # Panics
    /// If this policy is over more than one environment: a defect of the caller.
    pub fn act_with_insight(&mut self, step: &Step, actions: Actions) -> (Vec<f32>, Insight) {
        let decision = self.decide(&[step]);
        let insight = Insight {
            attention: decision.attention.as_ref().map(values).unwrap_or_default(),
            gate: decision.gate.as_ref().map(|open| values(open)[0]),
        };
        (values(&decision.actions(actions)), insight)
    }

    /// What would be remembered at every step of an episode, `[T, ..]`, without a change of the memory.
    ///
    /// # Panics
    /// If this episode has images of other sizes than the environment: a defect of the caller.
    pub fn memories(&self, episode: &Steps) -> Memory {
        let side = self.spec.image.height;
        let staged = StagedSteps::new(std::slice::from_ref(episode), side, Device::Cpu);
        let batch = staged.to_batch(Device::Cpu);
        let memories = self.model.observe(&batch.images, &batch.actions);
        memories.map(|x| x.squeeze_dim(0))
    }

    /// Goes on from another memory of the only environment, `[1, ..]`.
    pub fn remember(&mut self, memory: Memory) {
        self.memory = memory;
    }

    /// [`imagined_returns`] by the latent dynamics of this policy.
    ///
    /// # Shapes
    /// `-> [N]`
    pub fn imagined_returns(&self, reward: &RewardModel, plans: &Plans, samples: i64) -> Vec<f64> {
        let returns = imagined_returns(self.model.rssm(), reward.head(), plans, samples);
        values(&returns).into_iter().map(f64::from).collect()
    }

    fn decide(&mut self, steps: &[&Step]) -> Decision {
        let image = self.spec.image;
        let count = steps.len() as i64;
        let pixels: Vec<u8> = steps
            .iter()
            .flat_map(|step| step.image.iter().copied())
            .collect();
        let pixels = Tensor::from_slice(&pixels).view([
            count,
            image.height as i64,
            image.width as i64,
            image.channels as i64,
        ]);
        let executed: Vec<f32> = steps
            .iter()
            .flat_map(|step| step.action.iter().copied())
            .collect();
        let executed = Tensor::from_slice(&executed).view([count, -1]);
        let is_first: Vec<bool> = steps.iter().map(|step| step.is_first).collect();
        self.model
            .step(&mut self.memory, &preprocess(&pixels), &executed, &is_first)
    }
}

/// All numbers of a tensor, row after row.
fn values(tensor: &Tensor) -> Vec<f32> {
    let mut values = vec![0.0; tensor.numel()];
    let count = values.len();
    tensor.contiguous().copy_data(&mut values, count);
    values
}
