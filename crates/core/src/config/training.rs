//! `[behavior]`, `[optimizer]`, `[learner]` and `[actor]`

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Config;
use super::replay::TRAIN_TABLE;

/// Imagination, actor and critic (Eq. 13, 14).
#[derive(Debug, Clone, PartialEq, JsonSchema, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BehaviorConfig {
    /// States per imagined trajectory, the start included (the paper's `L`).
    pub imagination_horizon: i64,
    /// Noncontrollable states the policy attends to, the current one included (`tau`); 0 leaves attention out.
    pub rollout_window: i64,
    /// `gamma`.
    pub discount: f64,
    /// `lambda` of the lambda-return.
    pub lambda: f64,
    /// Weight of the policy's entropy.
    pub entropy_scale: f64,
    /// Whether the actor's returns are divided by their running range (5th to 95th percentile, 1 at the least), as in
    /// DreamerV3: one `entropy_scale` fits rewards of any size. The paper's and the authors' returns are not.
    pub normalize_returns: bool,
    /// Weight of `sum max(0, |m| - mean_limit)^2` in the actor's loss, `m` its mean before `tanh`. With the authors' 0 an
    /// actor can saturate within a hundred updates, and gets no gradient from then on.
    pub mean_penalty: f64,
    /// What `|m|` may be without a penalty. With 0, an action that brings nothing goes back to the middle of its range.
    pub mean_limit: f64,
    /// Updates between two moves of the slow critic towards the critic.
    pub slow_critic_interval: u64,
    /// How far it moves, in (0, 1]: 1 copies the critic, as in the paper.
    pub slow_critic_fraction: f64,
    /// Whether the actor also receives the value's gradient through `e_t`. The authors' driving code cuts it.
    pub value_gradient: bool,
    /// Share of the replayed states from which imagination starts, in (0, 1].
    pub start_share: f64,
    /// How many times the actor's gradient counts in the states from which imagination starts. These alone are observed, as
    /// the deployed policy's states are; all others are imagined. The paper's 1 counts all alike.
    pub start_weight: f64,
    /// Share of the imagined trajectories that take the most likely actions, as the evaluated policy does, from 0 to 1. The
    /// others draw theirs, as all do with the paper's 0.
    pub greedy_share: f64,
    /// Weight of the critic's loss on replayed sequences, as in DreamerV3: lambda-returns of the rewards that were really had,
    /// which end in imagined returns. Imagination then starts from whole sequences. With the paper's 0 the critic knows
    /// imagined rewards alone, and believes what the model is wrong about.
    pub replay_value_scale: f64,
    /// Updates of the world model before actor and critic begin to learn. The paper's 0 lets the actor chase
    /// the rewards of an untrained model, which short runs do not recover from.
    pub warmup_updates: u64,
}

impl Default for BehaviorConfig {
    fn default() -> Self {
        Self {
            imagination_horizon: 15,
            rollout_window: 5,
            discount: 0.99,
            lambda: 0.95,
            entropy_scale: 1e-4,
            normalize_returns: false,
            mean_penalty: 0.0,
            mean_limit: 1.0,
            slow_critic_interval: 100,
            slow_critic_fraction: 1.0,
            value_gradient: true,
            start_share: 1.0,
            start_weight: 1.0,
            greedy_share: 0.0,
            replay_value_scale: 0.0,
            warmup_updates: 0,
        }
    }
}

/// Adam and gradient clipping.
#[derive(Debug, Clone, PartialEq, JsonSchema, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OptimizerConfig {
    /// Learning rate of the world model.
    pub model_lr: f64,
    /// Learning rate of the actor.
    pub actor_lr: f64,
    /// Learning rate of critic and attention.
    pub critic_lr: f64,
    /// Share of the learning rates that is left at the end of the run, in (0, 1]: they fall in a straight line. 1 keeps
    /// them, as in the paper.
    pub final_share: f64,
    /// Adam's epsilon.
    pub eps: f64,
    /// Greatest global norm of a gradient.
    pub grad_clip: f64,
}

impl Default for OptimizerConfig {
    fn default() -> Self {
        Self {
            model_lr: 3e-4,
            actor_lr: 8e-5,
            critic_lr: 8e-5,
            final_share: 1.0,
            eps: 1e-5,
            grad_clip: 100.0,
        }
    }
}

/// In which numbers the learner multiplies. Weights, optimisers, recurrent states and losses are `f32` always.
#[derive(Debug, Clone, Copy, PartialEq, Eq, JsonSchema, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// `f32`.
    Fp32,
    /// `bf16` in convolutions and in products over many rows, accumulated in `f32`.
    Bf16,
    /// `bf16` on CPUs that have instructions for it and on GPUs, else `f32`.
    Auto,
}

/// The training loop.
#[derive(Debug, Clone, PartialEq, JsonSchema, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LearnerConfig {
    /// Sequences per batch (B).
    pub batch_size: usize,
    /// Steps per sequence (L); shorter episodes are stored but not trained on.
    pub batch_length: usize,
    /// Environment frames (action repeat counted) after which training ends.
    pub env_frames: u64,
    /// Agent steps collected with random actions before training starts.
    pub prefill_steps: u64,
    /// Updates made at once when training starts.
    pub pretrain_updates: u64,
    /// Updates per agent step after that.
    pub replay_ratio: f64,
    /// Updates between two published policies.
    pub publish_interval: u64,
    /// Updates between two checkpoints; where that takes longer than five minutes, there is one every five minutes.
    pub checkpoint_interval: u64,
    /// A run directory or checkpoint whose parameters a new run begins with, for transfer; empty: at random.
    pub initial: String,
    /// Which parameters are taken: those with one of these words in their name, `noncontrollable` for example takes the
    /// whole branch (`world_model.rssm.noncontrollable.gru...`, its encoder and its decoder); empty: all.
    pub initial_parts: Vec<String>,
    /// Seconds that a learner which is told to stop waits for the running update, so that it can be kept. Leave it
    /// below what the machine's supervisor waits before it kills (Docker 10 s unless told, Kubernetes 30 s).
    /// `isodream train` waits for 6 s at most, so that Ctrl-C takes no more than ten: where an update takes longer, what
    /// follows the newest checkpoint, five minutes at most, is trained again.
    pub stop_secs: f64,
    /// Checkpoints kept, at least 2.
    pub keep_checkpoints: usize,
    /// Updates between two lines of metrics.
    pub log_interval: u64,
    /// The table of `[replay.tables]` that is trained on.
    pub table: String,
    /// Threads that decode sampled sequences.
    pub decode_threads: usize,
    /// Batches decoded ahead of training.
    pub prefetch_batches: usize,
    /// Threads of one tensor operation; 0 leaves the choice to libtorch.
    pub threads: i32,
    /// Threads that each compute the gradients of a share of the batch, on a CPU: for models too small to gain from
    /// `threads`. Each draws noise of its own and counts its own free nats, so that another number is another run.
    pub workers: usize,
    /// In which numbers matrices are multiplied.
    pub precision: Precision,
}

impl Default for LearnerConfig {
    fn default() -> Self {
        Self {
            batch_size: 50,
            batch_length: 50,
            env_frames: 500_000,
            prefill_steps: 2_500,
            pretrain_updates: 100,
            replay_ratio: 0.2,
            publish_interval: 10,
            checkpoint_interval: 500,
            initial: String::new(),
            initial_parts: Vec::new(),
            stop_secs: 20.0,
            keep_checkpoints: 2,
            log_interval: 50,
            table: TRAIN_TABLE.to_owned(),
            decode_threads: 2,
            prefetch_batches: 3,
            threads: 0,
            workers: 1,
            precision: Precision::Fp32,
        }
    }
}

/// How an actor acts before there is a policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, JsonSchema, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Prefill {
    /// Every action is drawn by itself, uniformly: the paper's.
    Random,
    /// Random actions that are held for some steps, so that speeds and contacts come about which white noise never
    /// reaches.
    Wander,
}

/// The actors that `train` starts and how they act.
#[derive(Debug, Clone, PartialEq, JsonSchema, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ActorConfig {
    /// Collecting actors.
    pub collectors: usize,
    /// Environments that one actor steps as a batch.
    pub environments: usize,
    /// How collecting actors act before there is a policy.
    pub prefill: Prefill,
    /// Share of their steps that collecting actors act at random later on, in stretches of held actions; 0 as in the
    /// paper, which samples from the policy alone.
    pub explore_share: f64,
    /// Share of their episodes in which collecting actors take the most likely action in place of a sample, as
    /// evaluations do, so that the world model learns where this leads; 0 as in the paper.
    pub greedy_share: f64,
    /// Chunks an actor holds unacknowledged before it pauses its environments.
    pub spool_chunks: usize,
    /// The same in MB of chunks as they are encoded; a single chunk always has room.
    pub spool_mb: usize,
    /// Environment frames between two evaluations.
    pub evaluate_interval_frames: u64,
    /// Episodes of one evaluation.
    pub evaluate_episodes: u32,
    /// States of an evaluation at which the world model is probed: several plans of actions are followed really, by
    /// repeating the episode from its seed, and in imagination, and their returns are compared; 0 for none.
    pub probe_states: usize,
    /// Threads of one tensor operation in an actor.
    pub threads: i32,
}

impl Default for ActorConfig {
    fn default() -> Self {
        Self {
            collectors: 2,
            environments: 1,
            prefill: Prefill::Random,
            explore_share: 0.0,
            greedy_share: 0.0,
            spool_chunks: 8,
            spool_mb: 64,
            evaluate_interval_frames: 5_000,
            evaluate_episodes: 1,
            probe_states: 6,
            threads: 1,
        }
    }
}

impl Config {
    /// Updates of the whole run: pretraining, and the replay ratio over the agent steps after prefill.
    pub fn total_updates(&self) -> u64 {
        let agent_steps = self.learner.env_frames / u64::from(self.env.action_repeat);
        let trained_steps = agent_steps.saturating_sub(self.learner.prefill_steps);
        self.learner.pretrain_updates + (trained_steps as f64 * self.learner.replay_ratio) as u64
    }

    /// Steps in one batch.
    pub fn batch_steps(&self) -> u64 {
        (self.learner.batch_size * self.learner.batch_length) as u64
    }

    /// Steps drawn per step inserted: the replay ratio in the unit of the rate limiter.
    pub fn samples_per_insert(&self) -> f64 {
        self.learner.replay_ratio * self.batch_steps() as f64
    }

    /// Frames of a sequence that branches reconstruct from posterior samples: (controllable, noncontrollable).
    pub fn posterior_steps(&self) -> (i64, i64) {
        let length = self.learner.batch_length as f64;
        let steps = |share: f64| (share * length).round() as i64;
        (
            steps(self.loss.controllable_posterior_share),
            steps(self.loss.noncontrollable_posterior_share),
        )
    }
}
