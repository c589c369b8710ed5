//! The policy: rollouts of the noncontrollable branch, future-state attention and the actor
//! (Iso-Dream++ Eq. 13, 14; Alg. 1, lines 9-12 and 22-24).
//!
//! [`Policy::look_ahead`] and [`Policy::act`] serve imagination and deployment alike, so that training and
//! acting cannot drift apart.

use isodream_core::Config;
use isodream_core::config::FutureStates;
use safetensors::SafeTensors;
use tch::{Device, Kind, Tensor};

use crate::attention::{Attended, FutureAttention};
use crate::distribution::TruncatedNormal;
use crate::encoder::{Embeddings, Encoder, stack_frames};
use crate::nn::Mlp;
use crate::params::{LoadError, Params, Scope};
use crate::rssm::{Latent, Rssm, State};

/// How an action is taken from the distribution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Actions {
    /// Drawn: collecting.
    Sample,
    /// The mode: evaluating.
    Mode,
}

/// The actor `pi(a_t | e_t)`.
#[derive(Debug)]
pub struct Actor {
    mlp: Mlp,
    min_std: f64,
}

impl Actor {
    /// The actor of `config`.
    pub fn new(scope: Scope<'_>, config: &Config, action_dim: i64) -> Self {
        let model = &config.model;
        Self {
            mlp: Mlp::new(
                scope,
                feat_width(config),
                model.actor_layers,
                model.units,
                2 * action_dim,
            ),
            min_std: model.policy_min_std,
        }
    }

    /// What the distribution is made of.
    ///
    /// # Shapes
    /// `e: [.., feat] -> [.., 2 A]`
    pub fn raw(&self, feat: &Tensor) -> Tensor {
        self.mlp.forward(feat)
    }

    /// The distribution of actions that [`Self::raw`] stands for.
    pub fn distribution(&self, raw: &Tensor) -> TruncatedNormal {
        TruncatedNormal::from_raw(raw, self.min_std)
    }
}

/// What the noncontrollable branch foresees from a state.
#[derive(Debug)]
pub struct Lookahead {
    /// `[z_t, z_{t+1}, .., z_{t+tau-1}]` with their recurrent states, detached: `[N, tau, feat]`. Absent where
    /// the policy does not look ahead.
    pub memory: Option<Tensor>,
    /// `h'_{t+1}`, which the next imagined step needs as well; absent where `z` is ignored.
    pub next_deter: Option<Tensor>,
    /// Openings `w_t` of the dependency gate: `[N, 1]` (Eq. 11); absent without a gate.
    pub gate: Option<Tensor>,
}

/// A decision and what it was made of.
#[derive(Debug)]
pub struct Decision {
    /// The policy's distribution of actions, `[M, A]`.
    pub distribution: TruncatedNormal,
    /// Weights over the rollout `[M, tau]` (Eq. 13); absent where the policy does not look ahead.
    pub attention: Option<Tensor>,
    /// Openings of the dependency gate `[M, 1]` (Eq. 11); absent without a gate.
    pub gate: Option<Tensor>,
}

impl Decision {
    /// Actions taken as `how` says, `[M, A]`; samples are drawn anew each time.
    pub fn actions(&self, how: Actions) -> Tensor {
        match how {
            Actions::Sample => self.distribution.sample(),
            Actions::Mode => self.distribution.mode(),
        }
    }
}

/// How foreseen states enter the policy.
#[derive(Debug, Clone, Copy)]
pub enum Future<'a> {
    /// By attention (Eq. 13).
    Attention(&'a FutureAttention),
    /// Beside the controllable state, the paper's ablation.
    Concatenation,
}

impl<'a> Future<'a> {
    /// As `config` says; `attention` is what it asks for.
    pub fn of(config: &Config, attention: Option<&'a FutureAttention>) -> Option<Self> {
        match attention {
            Some(attention) => Some(Self::Attention(attention)),
            None => looks_ahead(config).then_some(Self::Concatenation),
        }
    }
}

/// Borrows everything that turns a state into an action.
#[derive(Debug)]
pub struct Policy<'a> {
    /// Latent dynamics, for the rollouts.
    pub rssm: &'a Rssm,
    /// How foreseen states enter; absent with the indicator off or an empty window.
    pub future: Option<Future<'a>>,
    /// The actor.
    pub actor: &'a Actor,
    /// Whether noncontrollable states count (the indicator).
    pub indicator: bool,
    /// `tau`.
    pub window: i64,
}

impl Policy<'_> {
    /// Rolls the noncontrollable branch `tau - 1` steps into the future: the first through the dependency
    /// gate, the others on its own (Alg. 1, lines 9-10 and 22-23).
    pub fn look_ahead(&self, state: &State) -> Lookahead {
        if !self.indicator {
            return Lookahead {
                memory: None,
                next_deter: None,
                gate: None,
            };
        }
        let gated = self.rssm.gated(state);
        let z = &state.noncontrollable;
        let next_deter = self.rssm.free_transition(&gated.stoch, &z.deter);
        let memory = self.future.map(|_| {
            tch::no_grad(|| {
                let now = Latent {
                    stoch: gated.stoch.shallow_clone(),
                    deter: z.deter.shallow_clone(),
                };
                let mut memory = vec![now.feat()];
                let mut deter = next_deter.shallow_clone();
                while (memory.len() as i64) < self.window {
                    let stoch = self.rssm.noncontrollable.prior(&deter).sample();
                    let latent = Latent { stoch, deter };
                    memory.push(latent.feat());
                    let alone = match &self.rssm.gate {
                        Some(gate) => gate.merge_shut(&latent.stoch),
                        None => latent.stoch,
                    };
                    deter = if (memory.len() as i64) < self.window {
                        self.rssm.free_transition(&alone, &latent.deter)
                    } else {
                        latent.deter
                    };
                }
                Tensor::stack(&memory, 1)
            })
        });
        Lookahead {
            memory,
            next_deter: Some(next_deter),
            gate: gated.open,
        }
    }

    /// `e_t` (Eq. 13); the controllable features themselves where the policy does not look ahead.
    ///
    /// # Shapes
    /// `-> [N, feat]`, or [`feat_width`] where foreseen states are concatenated
    pub fn feat(&self, state: &State, lookahead: &Lookahead) -> Tensor {
        self.attend(state, lookahead).0
    }

    /// [`Self::feat`] with the weights over the memory `[N, tau]`, if there is one.
    fn attend(&self, state: &State, lookahead: &Lookahead) -> (Tensor, Option<Tensor>) {
        let controllable = state.controllable.feat();
        match (self.future, &lookahead.memory) {
            (Some(Future::Attention(attention)), Some(memory)) => {
                let Attended { feat, weights } = attention.forward(&controllable, memory);
                (feat, Some(weights))
            }
            (Some(Future::Concatenation), Some(memory)) => {
                let all = Tensor::cat(&[controllable, memory.flatten(1, -1)], -1);
                (all, None)
            }
            _ => (controllable, None),
        }
    }

    /// The distribution of actions at features `e_t` (Eq. 14).
    ///
    /// # Shapes
    /// `[N, feat] -> [N, A]`
    pub fn act(&self, feat: &Tensor) -> TruncatedNormal {
        self.actor.distribution(&self.actor.raw(feat))
    }
}

/// What acting remembers from one step to the next.
#[derive(Debug)]
pub struct Memory {
    /// The latents of the newest step, `[M, ..]`.
    pub state: State,
    /// What the encoder saw then ([`stack_frames`]), `[M, 3 frames, 64, 64]`.
    pub seen: Tensor,
}

impl Memory {
    /// Applies `f` to all parts.
    pub fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        Self {
            state: self.state.map(&f),
            seen: f(&self.seen),
        }
    }
}

/// The networks that acting needs, with their own parameters: what is published to actors.
#[derive(Debug)]
pub struct ActingModel {
    params: Params,
    encoder: Encoder,
    rssm: Rssm,
    attention: Option<FutureAttention>,
    actor: Actor,
    config: Config,
}

impl ActingModel {
    /// An acting model with random weights; [`Self::load`] gives it those of a learner.
    pub fn new(config: &Config, action_dim: usize, device: Device) -> Self {
        let action_dim = action_dim as i64;
        let mut params = Params::new(device);
        let mut world = params.root("world_model");
        let encoder = Encoder::new(
            world.sub("encoder"),
            &config.model,
            config.env.image_size as i64,
            action_dim,
        );
        let rssm = Rssm::new(world.sub("rssm"), &config.model, action_dim);
        let attention =
            attends(config).then(|| FutureAttention::new(params.root("attention"), &config.model));
        let actor = Actor::new(params.root("actor"), config, action_dim);
        params.flatten();
        Self {
            params,
            encoder,
            rssm,
            attention,
            actor,
            config: config.clone(),
        }
    }

    /// Names of the parameters that acting needs.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.params.entries().iter().map(|(name, _)| name.as_str())
    }

    /// Takes weights from safetensors bytes, published or of a checkpoint.
    ///
    /// # Errors
    /// [`LoadError`] where the bytes are damaged or of another model; the old weights stay then.
    pub fn load(&mut self, bytes: &[u8]) -> Result<(), LoadError> {
        self.params.load(&SafeTensors::deserialize(bytes)?)
    }

    /// The policy over these weights.
    pub fn policy(&self) -> Policy<'_> {
        Policy {
            rssm: &self.rssm,
            future: Future::of(&self.config, self.attention.as_ref()),
            actor: &self.actor,
            indicator: self.config.model.indicator,
            window: self.config.behavior.rollout_window,
        }
    }

    /// The memory before the first step of `environments` episodes.
    pub fn begin(&self, environments: i64) -> Memory {
        let device = self.params.device();
        let side = self.config.env.image_size as i64;
        let size = [
            environments,
            3 * self.config.model.encoder_frames,
            side,
            side,
        ];
        Memory {
            state: self.rssm.initial(environments, device),
            seen: Tensor::zeros(size, (Kind::Float, device)),
        }
    }

    /// What would be remembered at each step of a sequence that is observed from its first one on.
    ///
    /// # Shapes
    /// `images: [B, T, 3, 64, 64]`, `executed: [B, T, A]`, the actions that led to them `-> [B, T, ..]`
    pub fn observe(&self, images: &Tensor, executed: &Tensor) -> Memory {
        let _guard = tch::no_grad_guard();
        let lengths = [images.size()[0], images.size()[1]];
        let seen = stack_frames(images, self.config.model.encoder_frames);
        let stem = self.encoder.stem.forward(&seen.flatten(0, 1));
        let flat = self.encoder.embed(&stem, &executed.flatten(0, 1));
        let embed = Embeddings {
            controllable: flat.controllable.unflatten(0, lengths),
            noncontrollable: flat.noncontrollable.unflatten(0, lengths),
        };
        Memory {
            state: self.rssm.observe(executed, &embed).states,
            seen,
        }
    }

    /// The latent dynamics.
    pub fn rssm(&self) -> &Rssm {
        &self.rssm
    }

    /// One decision (Alg. 1, lines 21-24): posterior, rollout, attention, action. Environments that were just
    /// reset (`is_first`) start from the initial memory.
    ///
    /// # Shapes
    /// `images: [M, 3, 64, 64]`, `executed: [M, A]`, the actions that led to them, zero after a reset,
    /// `is_first: [M]`; what is returned lies on the CPU.
    pub fn step(
        &self,
        memory: &mut Memory,
        images: &Tensor,
        executed: &Tensor,
        is_first: &[bool],
    ) -> Decision {
        let _guard = tch::no_grad_guard();
        let device = self.params.device();
        let (images, executed) = (images.to_device(device), executed.to_device(device));
        if is_first.contains(&true) {
            let keep: Vec<f32> = is_first
                .iter()
                .map(|&first| f32::from(u8::from(!first)))
                .collect();
            let keep = Tensor::from_slice(&keep).to_device(device);
            memory.state = memory.state.map(|x| x * keep.view([-1, 1]));
            memory.seen = &memory.seen * keep.view([-1, 1, 1, 1]);
        }
        let Memory { state, seen } = memory;
        let earlier = 3 * (self.config.model.encoder_frames - 1);
        *seen = Tensor::cat(&[&images, &seen.narrow(1, 0, earlier)], 1);
        let stem = self.encoder.stem.forward(seen);
        let embed = self.encoder.embed(&stem, &executed);
        *state = self.rssm.observe_step(state, &executed, &embed);
        let policy = self.policy();
        let lookahead = policy.look_ahead(state);
        let (feat, attention) = policy.attend(state, &lookahead);
        let TruncatedNormal { mean, std } = policy.act(&feat);
        Decision {
            distribution: TruncatedNormal {
                mean: mean.to_device(Device::Cpu),
                std: std.to_device(Device::Cpu),
            },
            attention: attention.map(|weights| weights.to_device(Device::Cpu)),
            gate: lookahead.gate.map(|open| open.to_device(Device::Cpu)),
        }
    }
}

/// Whether the policy of `config` attends to what it foresees.
pub fn attends(config: &Config) -> bool {
    looks_ahead(config) && config.model.future == FutureStates::Attention
}

/// Width of what actor and critic of `config` see: `e_t`, or the controllable state with all foreseen ones.
pub fn feat_width(config: &Config) -> i64 {
    let feat = config.model.stoch + config.model.deter;
    if looks_ahead(config) && config.model.future == FutureStates::Concatenation {
        return feat * (1 + config.behavior.rollout_window);
    }
    feat
}

/// Whether the policy of `config` uses rollouts.
pub fn looks_ahead(config: &Config) -> bool {
    config.model.indicator && config.behavior.rollout_window > 0
}
