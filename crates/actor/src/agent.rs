//! Published weights acting on a vector of environments.

use isodream_core::{Config, EnvSpec, Step};
use isodream_model::batch::preprocess;
use isodream_model::rssm::State;
use isodream_model::{ActingModel, Actions, LoadError};
use tch::{Device, Tensor};

/// A policy with its recurrent memory over a vector of environments.
#[derive(Debug)]
pub struct AgentPolicy {
    model: ActingModel,
    state: State,
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
        let state = model.begin(environments as i64);
        Ok(Self {
            model,
            state,
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

    /// One action per environment, from the newest step of each.
    pub fn act(&mut self, steps: &[&Step], actions: Actions) -> Vec<Vec<f32>> {
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
        let chosen = self.model.step(
            &mut self.state,
            &preprocess(&pixels),
            &executed,
            &is_first,
            actions,
        );
        let mut flat = vec![0.0; steps.len() * self.spec.action_dim];
        let count = flat.len();
        chosen.contiguous().copy_data(&mut flat, count);
        flat.chunks(self.spec.action_dim)
            .map(<[f32]>::to_vec)
            .collect()
    }
}
