//! Published weights acting on a vector of environments.

use isodream_core::{Config, EnvSpec};
use isodream_model::agent::preprocess;
use isodream_model::policy::Memory;
use isodream_model::{ActingModel, Actions, LoadError};
use tch::{Device, Tensor};

/// A policy with its recurrent memory over `environments`.
#[derive(Debug)]
pub struct AgentPolicy {
    model: ActingModel,
    memory: Memory,
    spec: EnvSpec,
    environments: usize,
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
        let memory = model.begin(environments as i64, spec.action_dim as i64);
        Ok(Self {
            model,
            memory,
            spec: spec.clone(),
            environments,
        })
    }

    /// Takes newer weights and keeps the memory, so that weights may change in the middle of an episode.
    ///
    /// # Errors
    /// [`LoadError`]; the old weights stay then.
    pub fn load(&mut self, weights: &[u8]) -> Result<(), LoadError> {
        self.model.load(weights)
    }

    /// One action per environment. `is_first` marks those that were just reset.
    ///
    /// # Shapes
    /// `images: [M, H, W, C]` bytes `-> M` actions
    pub fn act(&mut self, images: &[u8], is_first: &[bool], actions: Actions) -> Vec<Vec<f32>> {
        let image = self.spec.image;
        let shape = [
            self.environments as i64,
            image.height as i64,
            image.width as i64,
            image.channels as i64,
        ];
        let pixels = preprocess(&Tensor::from_slice(images).view(shape));
        let chosen = self
            .model
            .step(&mut self.memory, &pixels, is_first, actions);
        let mut flat = vec![0.0; self.environments * self.spec.action_dim];
        let count = flat.len();
        chosen.contiguous().copy_data(&mut flat, count);
        flat.chunks(self.spec.action_dim)
            .map(<[f32]>::to_vec)
            .collect()
    }
}
