//! The recurrent state-space models of the two dynamic branches (Iso-Dream++ Eq. 3, 12).

use isodream_core::config::ModelConfig;
use tch::{Device, Kind, Tensor};

use crate::encoder::{Embeddings, embed_dim};
use crate::gate::DependencyGate;
use crate::nn::{GruCell, Linear};
use crate::noise::normal_like;
use crate::params::Scope;

/// A diagonal Gaussian, `[.., stoch]`.
#[derive(Debug)]
pub struct Gaussian {
    /// Unbounded.
    pub mean: Tensor,
    /// In `[min_std, min_std + 2]`.
    pub std: Tensor,
}

impl Gaussian {
    /// `mean + std eps` with fresh noise: reparameterised.
    pub fn sample(&self) -> Tensor {
        &self.mean + &self.std * normal_like(&self.std)
    }

    /// Both parts cut from the graph.
    pub fn detach(&self) -> Self {
        self.map(Tensor::detach)
    }

    /// Applies `f` to both parts.
    pub fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        Self {
            mean: f(&self.mean),
            std: f(&self.std),
        }
    }

    fn stack(steps: &[Self]) -> Self {
        let join = |part: fn(&Self) -> &Tensor| {
            Tensor::stack(&steps.iter().map(part).collect::<Vec<_>>(), 1)
        };
        Self {
            mean: join(|g| &g.mean),
            std: join(|g| &g.std),
        }
    }
}

/// One branch's latent: sample and recurrent state.
#[derive(Debug)]
pub struct Latent {
    /// `s_t` or `z_t`: `[.., stoch]`.
    pub stoch: Tensor,
    /// `h_t` or `h'_t`: `[.., deter]`.
    pub deter: Tensor,
}

impl Latent {
    /// `[stoch, deter]`: `[.., stoch + deter]`.
    pub fn feat(&self) -> Tensor {
        Tensor::cat(&[&self.stoch, &self.deter], -1)
    }

    /// Cut from the graph.
    pub fn detach(&self) -> Self {
        self.map(Tensor::detach)
    }

    /// Applies `f` to both parts.
    pub fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        Self {
            stoch: f(&self.stoch),
            deter: f(&self.deter),
        }
    }
}

/// The latents of both branches at one time step.
#[derive(Debug)]
pub struct State {
    /// `(s, h)`.
    pub controllable: Latent,
    /// `(z, h')`.
    pub noncontrollable: Latent,
}

impl State {
    /// `[s, h, z, h']`, what the reward head sees when the indicator is on.
    pub fn joint_feat(&self) -> Tensor {
        Tensor::cat(
            &[&self.controllable.feat(), &self.noncontrollable.feat()],
            -1,
        )
    }

    /// Applies `f` to all four parts.
    pub fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        Self {
            controllable: self.controllable.map(&f),
            noncontrollable: self.noncontrollable.map(&f),
        }
    }
}

/// One branch: an input layer, a GRU and two Gaussian heads.
#[derive(Debug)]
pub struct Branch {
    input: Linear,
    gru: GruCell,
    prior: Linear,
    prior_stats: Linear,
    posterior: Linear,
    posterior_stats: Linear,
    deter: i64,
    min_std: f64,
}

impl Branch {
    /// A branch of `config` with `action_dim` action inputs, for embeddings of width `embed`.
    pub fn new(mut scope: Scope<'_>, config: &ModelConfig, action_dim: i64, embed: i64) -> Self {
        let (stoch, deter, hidden) = (config.stoch, config.deter, config.hidden);
        Self {
            input: Linear::new(scope.sub("input"), stoch + action_dim, hidden),
            gru: GruCell::new(scope.sub("gru"), hidden, deter),
            prior: Linear::new(scope.sub("prior"), deter, hidden),
            prior_stats: Linear::new(scope.sub("prior_stats"), hidden, 2 * stoch),
            posterior: Linear::new(scope.sub("posterior"), deter + embed, hidden),
            posterior_stats: Linear::new(scope.sub("posterior_stats"), hidden, 2 * stoch),
            deter,
            min_std: config.min_std,
        }
    }

    /// `h_t = GRU(h_{t-1}, [s_{t-1}, a_{t-1}])`.
    ///
    /// # Shapes
    /// `stoch: [N, stoch]`, `action: [N, A]`, `deter: [N, deter]` `-> [N, deter]`
    pub fn transition(&self, stoch: &Tensor, action: &Tensor, deter: &Tensor) -> Tensor {
        let x = self.input.forward(&Tensor::cat(&[stoch, action], -1)).elu();
        self.gru.forward(&x, deter)
    }

    /// `p(s_t | h_t)` (Eq. 3).
    ///
    /// # Shapes
    /// `[.., deter] -> [.., stoch]` twice
    pub fn prior(&self, deter: &Tensor) -> Gaussian {
        self.gaussian(&self.prior_stats.forward(&self.prior.forward(deter).elu()))
    }

    /// The embedding's share of the posterior's first layer. It has no recurrence, so whole sequences pass
    /// it in one product before the scan.
    ///
    /// # Shapes
    /// `[.., embed] -> [.., hidden]`
    pub fn project_embed(&self, embed: &Tensor) -> Tensor {
        let width = self.posterior.weight.size()[1] - self.deter;
        let weight = self.posterior.weight.narrow(1, self.deter, width);
        embed.linear(&weight, Some(&self.posterior.bias))
    }

    /// `q(s_t | h_t, o_t)`, the observation given by [`Self::project_embed`].
    ///
    /// # Shapes
    /// `deter: [N, deter]`, `projected: [N, hidden]` `-> [N, stoch]` twice
    pub fn posterior(&self, deter: &Tensor, projected: &Tensor) -> Gaussian {
        let weight = self.posterior.weight.narrow(1, 0, self.deter);
        let hidden = (deter.linear::<&Tensor>(&weight, None) + projected).elu();
        self.gaussian(&self.posterior_stats.forward(&hidden))
    }

    /// Mean and `std = 2 sigmoid(raw / 2) + min_std`.
    fn gaussian(&self, stats: &Tensor) -> Gaussian {
        let halves = stats.chunk(2, -1);
        Gaussian {
            mean: halves[0].shallow_clone(),
            std: (&halves[1] / 2.0).sigmoid() * 2.0 + self.min_std,
        }
    }
}

/// Both branches and the gate between them.
#[derive(Debug)]
pub struct Rssm {
    /// The action-conditioned branch.
    pub controllable: Branch,
    /// The action-free branch; its action inputs are zero except in the variance constraint.
    pub noncontrollable: Branch,
    /// The sparse dependency of the noncontrollable on the controllable branch.
    pub gate: Option<DependencyGate>,
    stoch: i64,
    deter: i64,
    action_dim: i64,
}

/// The noncontrollable branch's input `z_{t-1}` after the gate, with the gate's opening.
#[derive(Debug)]
pub struct Gated {
    /// `[N, stoch]`.
    pub stoch: Tensor,
    /// `w`: `[N, 1]`; absent without a gate.
    pub open: Option<Tensor>,
}

/// A whole observed sequence, all `[B, T, ..]`.
#[derive(Debug)]
pub struct Observed {
    /// Posterior samples and recurrent states.
    pub states: State,
    /// `q(s_t | h_t, o_t)`.
    pub controllable_posterior: Gaussian,
    /// `p(s_t | h_t)`.
    pub controllable_prior: Gaussian,
    /// `q(z_t | h'_t, o_t)`.
    pub noncontrollable_posterior: Gaussian,
    /// `p(z_t | h'_t)`.
    pub noncontrollable_prior: Gaussian,
    /// States each transition started from; row 0 is the initial state, and `z` is gated already.
    pub previous: State,
    /// Gate openings `[B, T, 1]`; absent without a gate.
    pub gate_open: Option<Tensor>,
}

impl Rssm {
    /// The branches of `config`.
    pub fn new(mut scope: Scope<'_>, config: &ModelConfig, action_dim: i64) -> Self {
        Self {
            controllable: Branch::new(
                scope.sub("controllable"),
                config,
                action_dim,
                embed_dim(config),
            ),
            noncontrollable: Branch::new(
                scope.sub("noncontrollable"),
                config,
                action_dim,
                embed_dim(config),
            ),
            gate: config
                .dependency_gate
                .then(|| DependencyGate::new(scope.sub("dependency"), config)),
            stoch: config.stoch,
            deter: config.deter,
            action_dim,
        }
    }

    /// Zeros for `batch` episodes.
    pub fn initial(&self, batch: i64, device: Device) -> State {
        let zeros = |width: i64| Tensor::zeros([batch, width], (Kind::Float, device));
        let latent = || Latent {
            stoch: zeros(self.stoch),
            deter: zeros(self.deter),
        };
        State {
            controllable: latent(),
            noncontrollable: latent(),
        }
    }

    /// What enters the noncontrollable transition: `z`, merged with `w s` if there is a gate (Eq. 11, 12).
    pub fn gated(&self, state: &State) -> Gated {
        let (s, z) = (&state.controllable, &state.noncontrollable);
        match &self.gate {
            Some(gate) => {
                let open = gate.open(&z.deter, &s.deter);
                Gated {
                    stoch: gate.merge(&z.stoch, &s.stoch, &open),
                    open: Some(open),
                }
            }
            None => Gated {
                stoch: z.stoch.shallow_clone(),
                open: None,
            },
        }
    }

    /// One noncontrollable transition from a gated input with zero action: `h'_{t+1}`.
    pub fn free_transition(&self, gated: &Tensor, deter: &Tensor) -> Tensor {
        let action = Tensor::zeros(
            [gated.size()[0], self.action_dim],
            (Kind::Float, gated.device()),
        );
        self.noncontrollable.transition(gated, &action, deter)
    }

    /// One step with an observation: posterior samples of both branches.
    ///
    /// # Shapes
    /// `action: [N, A]`, the action that led to the observation
    pub fn observe_step(&self, previous: &State, action: &Tensor, embed: &Embeddings) -> State {
        let projected = Embeddings {
            controllable: self.controllable.project_embed(&embed.controllable),
            noncontrollable: self.noncontrollable.project_embed(&embed.noncontrollable),
        };
        let gated = self.gated(previous);
        self.posterior_step(previous, &gated, action, &projected).0
    }

    fn posterior_step(
        &self,
        previous: &State,
        gated: &Gated,
        action: &Tensor,
        projected: &Embeddings,
    ) -> (State, Gaussian, Gaussian) {
        let s = &previous.controllable;
        let s_deter = self.controllable.transition(&s.stoch, action, &s.deter);
        let z_deter = self.free_transition(&gated.stoch, &previous.noncontrollable.deter);
        let s_posterior = self
            .controllable
            .posterior(&s_deter, &projected.controllable);
        let z_posterior = self
            .noncontrollable
            .posterior(&z_deter, &projected.noncontrollable);
        let state = State {
            controllable: Latent {
                stoch: s_posterior.sample(),
                deter: s_deter,
            },
            noncontrollable: Latent {
                stoch: z_posterior.sample(),
                deter: z_deter,
            },
        };
        (state, s_posterior, z_posterior)
    }

    /// One step without an observation: prior samples of both branches.
    ///
    /// # Shapes
    /// `action: [N, A]`
    pub fn imagine_step(&self, previous: &State, action: &Tensor) -> State {
        let gated = self.gated(previous);
        let z_deter = self.free_transition(&gated.stoch, &previous.noncontrollable.deter);
        self.imagine_step_to(previous, action, z_deter)
    }

    /// [`Self::imagine_step`] where the noncontrollable transition `h'_{t+1}` is known already, because the
    /// rollout of the policy has made it.
    pub fn imagine_step_to(&self, previous: &State, action: &Tensor, z_deter: Tensor) -> State {
        State {
            controllable: self.imagine_controllable(&previous.controllable, action),
            noncontrollable: Latent {
                stoch: self.noncontrollable.prior(&z_deter).sample(),
                deter: z_deter,
            },
        }
    }

    /// The states that `actions` alone lead to: prior samples of both branches.
    ///
    /// # Shapes
    /// `start: [N, ..]`, `actions: [N, K, A] -> [N, K, ..]`
    pub fn imagine(&self, start: &State, actions: &Tensor) -> State {
        let mut state = start.map(Tensor::shallow_clone);
        let mut states = Vec::new();
        for action in actions.unbind(1) {
            state = self.imagine_step(&state, &action);
            states.push(state.map(Tensor::shallow_clone));
        }
        stack(&states, 1)
    }

    /// One step of the controllable branch alone.
    pub fn imagine_controllable(&self, previous: &Latent, action: &Tensor) -> Latent {
        let deter = self
            .controllable
            .transition(&previous.stoch, action, &previous.deter);
        Latent {
            stoch: self.controllable.prior(&deter).sample(),
            deter,
        }
    }

    /// A whole sequence with observations. Only what is recurrent runs step by step.
    ///
    /// # Shapes
    /// `actions: [B, T, A]`, embeddings `[B, T, embed]`
    pub fn observe(&self, actions: &Tensor, embed: &Embeddings) -> Observed {
        let (batch, length) = (actions.size()[0], actions.size()[1]);
        let s_projected = self
            .controllable
            .project_embed(&embed.controllable)
            .unbind(1);
        let z_projected = self
            .noncontrollable
            .project_embed(&embed.noncontrollable)
            .unbind(1);
        let actions = actions.unbind(1);

        let mut state = self.initial(batch, actions[0].device());
        let capacity = length as usize;
        let mut states = Vec::with_capacity(capacity);
        let mut previous = Vec::with_capacity(capacity);
        let mut s_posteriors = Vec::with_capacity(capacity);
        let mut z_posteriors = Vec::with_capacity(capacity);
        let mut open = Vec::new();
        for ((action, s_projected), z_projected) in actions.iter().zip(s_projected).zip(z_projected)
        {
            let gated = self.gated(&state);
            let projected = Embeddings {
                controllable: s_projected,
                noncontrollable: z_projected,
            };
            let (next, s_posterior, z_posterior) =
                self.posterior_step(&state, &gated, action, &projected);
            s_posteriors.push(s_posterior);
            z_posteriors.push(z_posterior);
            open.extend(gated.open);
            let mut from = std::mem::replace(&mut state, next);
            from.noncontrollable.stoch = gated.stoch;
            previous.push(from);
            states.push(state.map(Tensor::shallow_clone));
        }
        let states = stack(&states, 1);
        Observed {
            controllable_prior: self.controllable.prior(&states.controllable.deter),
            noncontrollable_prior: self.noncontrollable.prior(&states.noncontrollable.deter),
            controllable_posterior: Gaussian::stack(&s_posteriors),
            noncontrollable_posterior: Gaussian::stack(&z_posteriors),
            previous: stack(&previous, 1),
            gate_open: (!open.is_empty()).then(|| Tensor::stack(&open, 1)),
            states,
        }
    }
}

/// Joins steps along a new axis: 1 gives `[B, T, ..]`, 0 gives `[T, B, ..]`.
pub fn stack(steps: &[State], axis: i64) -> State {
    let join = |part: fn(&State) -> &Tensor| {
        Tensor::stack(&steps.iter().map(part).collect::<Vec<_>>(), axis)
    };
    State {
        controllable: Latent {
            stoch: join(|s| &s.controllable.stoch),
            deter: join(|s| &s.controllable.deter),
        },
        noncontrollable: Latent {
            stoch: join(|s| &s.noncontrollable.stoch),
            deter: join(|s| &s.noncontrollable.deter),
        },
    }
}
