//! The configuration of a run: defaults < preset < `--config` file < `--set a.b=v`.
//!
//! The defaults are the paper's driving setup, so a field's default is its value in the paper, or in the
//! authors' code where the paper is silent or the published numbers come from the code; the field says so. An unknown key is refused with the nearest known one.

mod check;
mod environment;
mod load;
mod model;
mod replay;
mod training;

pub use environment::{BackgroundOrder, EnvConfig, NoiseTarget, RepeatReward};
pub use load::{ConfigError, PRESETS, Source};
pub use model::{Branches, FutureStates, InverseInput, LossConfig, ModelConfig, VarianceLoss};
pub use replay::{ReplayConfig, SelectorKind, TableConfig};
pub use training::{
    ActorConfig, BehaviorConfig, LearnerConfig, OptimizerConfig, Precision, Prefill,
};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Everything a run depends on. The resolved file lies in the run directory.
#[derive(Debug, Clone, Default, PartialEq, JsonSchema, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Root of the seed tree.
    pub seed: u64,
    /// The environment.
    pub env: EnvConfig,
    /// Sizes and options of the networks.
    pub model: ModelConfig,
    /// Weights and options of the world-model losses.
    pub loss: LossConfig,
    /// Imagination, actor and critic.
    pub behavior: BehaviorConfig,
    /// Learning rates and clipping.
    pub optimizer: OptimizerConfig,
    /// The replay-server.
    pub replay: ReplayConfig,
    /// The training loop.
    pub learner: LearnerConfig,
    /// The actors.
    pub actor: ActorConfig,
}
