//! Behaviour learning in isolated imaginations (Iso-Dream++ Alg. 1, lines 8-14; Eq. 14).

use isodream_core::Config;
use isodream_core::config::BehaviorConfig;
use tch::{Kind, Tensor};

use crate::distribution::{TruncatedNormal, saturation};
use crate::losses::HALF_LOG_2PI;
use crate::nn::Mlp;
use crate::noise::choose;
use crate::params::Scope;
use crate::policy::{Policy, feat_width};
use crate::rssm::{State, stack};
use crate::world_model::WorldModel;

/// The critic `v(e_t)`.
#[derive(Debug)]
pub struct Critic {
    mlp: Mlp,
}

impl Critic {
    /// The critic of `config`.
    pub fn new(scope: Scope<'_>, config: &Config) -> Self {
        let (feat, model) = (feat_width(config), &config.model);
        Self {
            mlp: Mlp::new(scope, feat, model.critic_layers, model.units, 1),
        }
    }

    /// # Shapes
    /// `[.., feat] -> [..]`
    pub fn forward(&self, feat: &Tensor) -> Tensor {
        self.mlp.forward(feat).squeeze_dim(-1)
    }
}

/// Imagined trajectories, time-major: `H` states from each of `N` starts.
#[derive(Debug)]
pub struct Imagined {
    /// `e_t` with the graph to earlier actions: `[H, N, feat]`.
    pub feats: Tensor,
    /// Reward means at each state: `[H, N]`.
    pub rewards: Tensor,
    /// `gamma` times the probability of going on: `d_t` scales what follows `x_t`, `[H, N]`.
    pub discounts: Tensor,
    /// What the policy chose, `[H - 1, N, A]`.
    pub actions: Tensor,
    /// Policy entropies at the states, `[H - 1, N]`.
    pub entropies: Tensor,
    /// How far the actor's outputs lie in the flat ends of `tanh` ([`saturation`]), `[H - 1, N]`.
    pub saturations: Tensor,
}

/// Imagines `H` states from detached starts, acting by `policy` on features cut from the graph; the first
/// `greedy_share` of the starts by its mode.
///
/// # Shapes
/// `starts: [N, ..]`
pub fn imagine(
    world: &WorldModel,
    policy: &Policy<'_>,
    starts: State,
    config: &BehaviorConfig,
) -> Imagined {
    let horizon = config.imagination_horizon;
    let mut state = starts;
    let mut feats = Vec::new();
    let mut states = Vec::new();
    let mut actions = Vec::new();
    let mut entropies = Vec::new();
    let mut saturations = Vec::new();
    for t in 0..horizon {
        let lookahead = policy.look_ahead(&state);
        let feat = policy.feat(&state, &lookahead);
        let next = (t + 1 < horizon).then(|| {
            let raw = policy.actor.raw(&feat.detach());
            let raw = if t == 0 {
                counted(raw, config.start_weight)
            } else {
                raw
            };
            saturations.push(saturation(&raw, config.mean_limit));
            let distribution = policy.actor.distribution(&raw);
            entropies.push(distribution.entropy());
            let action = greedy_in_part(&distribution, config.greedy_share);
            actions.push(action.shallow_clone());
            match lookahead.next_deter {
                Some(deter) => world.rssm.imagine_step_to(&state, &action, deter),
                // Nothing reads `z` with the indicator off: it stays as it is.
                None => State {
                    controllable: world
                        .rssm
                        .imagine_controllable(&state.controllable, &action),
                    noncontrollable: state.noncontrollable.detach(),
                },
            }
        });
        feats.push(feat);
        match next {
            Some(next) => states.push(std::mem::replace(&mut state, next)),
            None => states.push(state.map(Tensor::shallow_clone)),
        }
    }
    let states = stack(&states, 0);
    let rewards = world.reward(&states);
    let discounts = match world.continuation(&states) {
        Some(continuation) => continuation * config.discount,
        None => rewards.full_like(config.discount).detach(),
    };
    Imagined {
        feats: Tensor::stack(&feats, 0),
        rewards,
        discounts,
        actions: Tensor::stack(&actions, 0),
        entropies: Tensor::stack(&entropies, 0),
        saturations: Tensor::stack(&saturations, 0),
    }
}

/// Actions of which the first `share` are the most likely ones, and the others drawn: `[N, A]`.
fn greedy_in_part(distribution: &TruncatedNormal, share: f64) -> Tensor {
    let drawn = distribution.sample();
    let rows = drawn.size()[0];
    let greedy = (rows as f64 * share).round() as i64;
    if greedy == 0 {
        return drawn;
    }
    let modes = distribution.mode().narrow(0, 0, greedy);
    Tensor::cat(&[modes, drawn.narrow(0, greedy, rows - greedy)], 0)
}

/// `x` whose gradient counts `times`.
fn counted(x: Tensor, times: f64) -> Tensor {
    if times == 1.0 {
        return x;
    }
    &x * times + x.detach() * (1.0 - times)
}

/// The lambda-return of state-aligned rewards: `G_t = r_t + d_t ((1 - lambda) v_{t+1} + lambda G_{t+1})` with
/// `G_{H-1} = v_{H-1}`. (The authors' code returns it reversed in time by mistake.)
///
/// # Shapes
/// `[H, ..]` thrice `-> [H - 1, ..]`
pub fn lambda_return(rewards: &Tensor, values: &Tensor, discounts: &Tensor, lambda: f64) -> Tensor {
    let horizon = rewards.size()[0];
    let mut next = values.get(horizon - 1);
    let mut returns = Vec::new();
    for t in (0..horizon - 1).rev() {
        let bootstrap = values.get(t + 1) * (1.0 - lambda) + &next * lambda;
        next = rewards.get(t) + discounts.get(t) * bootstrap;
        returns.push(next.shallow_clone());
    }
    returns.reverse();
    Tensor::stack(&returns, 0)
}

/// `w_t = prod_{k<t} d_k`, the weight of step `t` in both losses; detached.
///
/// # Shapes
/// `[H, ..] -> [H - 1, ..]`
pub fn step_weights(discounts: &Tensor) -> Tensor {
    let steps = discounts.size()[0] - 1;
    let first = discounts.get(0).ones_like().unsqueeze(0);
    Tensor::cat(&[first, discounts.narrow(0, 0, steps - 1)], 0)
        .cumprod(0, Kind::Float)
        .detach()
}

/// `-mean w_t (G_t + eta H[pi(. | e_t)])`.
pub fn actor_loss(
    returns: &Tensor,
    entropies: &Tensor,
    weights: &Tensor,
    entropy_scale: f64,
) -> Tensor {
    -(weights * (returns + entropies * entropy_scale)).mean(Kind::Float)
}

/// The range of imagined returns without their outliers: from the 5th to the 95th percentile (DreamerV3), detached.
///
/// # Shapes
/// `[..] -> []`
pub fn return_range(returns: &Tensor) -> Tensor {
    let sorted = returns.detach().flatten(0, -1).sort(0, false).0;
    let last = sorted.size()[0] - 1;
    let at = |share: f64| sorted.get((share * last as f64).round() as i64);
    at(0.95) - at(0.05)
}

/// `mean w_t 0.5 (v(e_t) - sg G_t)^2` plus the constant of a unit Gaussian.
pub fn critic_loss(values: &Tensor, returns: &Tensor, weights: &Tensor) -> Tensor {
    let nll = (values - returns.detach()).square() * 0.5 + HALF_LOG_2PI;
    (weights * nll).mean(Kind::Float)
}

/// Replayed sequences: posterior states `[B, T, ..]`, and what was had there, `[B, T]`.
#[derive(Debug)]
pub struct Replayed {
    /// Detached.
    pub states: State,
    /// The reward that came with each state.
    pub rewards: Tensor,
    /// 0 where the episode terminates, else 1.
    pub discounts: Tensor,
}

/// Where imagination starts: `[N, ..]`, or the steps of whole sequences, one sequence after the other.
#[derive(Debug)]
pub struct Starts {
    /// Detached.
    pub states: State,
    /// What was really had in these sequences, `[N / T, T]`; none where the states are not in order.
    pub had: Option<(Tensor, Tensor)>,
}

impl Starts {
    /// How many.
    pub fn rows(&self) -> i64 {
        self.states.controllable.stoch.size()[0]
    }

    /// Parts of at most `rows` starts, or of one sequence, in their order.
    pub fn parts(&self, rows: i64) -> Vec<Self> {
        let length = self
            .had
            .as_ref()
            .map_or(1, |(rewards, _)| rewards.size()[1]);
        let sequences = self.rows() / length;
        let most = (rows / length).max(1);
        let mut parts = Vec::new();
        let mut first = 0;
        while first < sequences {
            let count = most.min(sequences - first);
            let of = |x: &Tensor| x.narrow(0, first, count);
            parts.push(Self {
                states: (self.states).map(|x| x.narrow(0, first * length, count * length)),
                had: (self.had.as_ref()).map(|(rewards, discounts)| (of(rewards), of(discounts))),
            });
            first += count;
        }
        parts
    }
}

/// Where imagination starts: everywhere, or in a random share of the states, or of the sequences where the critic learns
/// from these as well.
pub fn starts(replayed: &Replayed, config: &Config) -> Starts {
    let Replayed {
        states,
        rewards,
        discounts,
    } = replayed;
    let behavior = &config.behavior;
    let device = rewards.device();
    let some = |rows: i64| {
        let kept = (rows as f64 * behavior.start_share).ceil() as i64;
        choose(rows, kept.max(1), device)
    };
    if behavior.replay_value_scale > 0.0 {
        let chosen = some(rewards.size()[0]);
        let of = |x: &Tensor| x.index_select(0, &chosen);
        return Starts {
            states: states.map(|x| of(x).flatten(0, 1)),
            had: Some((of(rewards), of(discounts))),
        };
    }
    let flat = states.map(|x| x.flatten(0, 1));
    if behavior.start_share >= 1.0 {
        return Starts {
            states: flat,
            had: None,
        };
    }
    let chosen = some(flat.controllable.stoch.size()[0]);
    Starts {
        states: flat.map(|x| x.index_select(0, &chosen)),
        had: None,
    }
}

/// Lambda-returns of what was really had in replayed sequences, each ending in imagined returns: `[T - 1, M]`.
///
/// # Shapes
/// `imagined: [M T]`, the returns from the steps of `M` sequences; `had: [M, T]` twice
pub fn replayed_returns(
    imagined: &Tensor,
    (rewards, discounts): &(Tensor, Tensor),
    config: &BehaviorConfig,
) -> Tensor {
    // Nothing follows where the episode terminates, whatever is imagined.
    let imagined = imagined.detach().view_as(rewards);
    let values: Tensor = rewards.where_self(&discounts.eq(0.0), &imagined);
    lambda_return(
        &rewards.transpose(0, 1),
        &values.transpose(0, 1),
        &(discounts.transpose(0, 1) * config.discount),
        config.lambda,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replayed_returns_are_of_real_rewards_and_end_in_imagined_ones() {
        let config = BehaviorConfig {
            discount: 0.5,
            lambda: 0.8,
            ..BehaviorConfig::default()
        };
        // Two sequences of three steps; the second ends for good after its second step.
        let rewards = Tensor::from_slice(&[1.0_f32, 2.0, 3.0, 4.0, 5.0, 6.0]).view([2, 3]);
        let discounts = Tensor::from_slice(&[1.0_f32, 1.0, 1.0, 1.0, 0.0, 1.0]).view([2, 3]);
        let imagined = Tensor::from_slice(&[10.0_f32, 20.0, 30.0, 40.0, 50.0, 60.0]);
        let returns = replayed_returns(&imagined, &(rewards, discounts), &config);
        // r_1 + 0.5 * 30 and r_0 + 0.5 * (0.2 * 20 + 0.8 * 17); then 5 and 4 + 0.5 * 5.
        let wanted = Tensor::from_slice(&[9.8_f32, 6.5, 17.0, 5.0]).view([2, 2]);
        assert!(returns.allclose(&wanted, 1e-5, 1e-5, false), "{returns}");
    }

    #[test]
    fn starts_are_whole_sequences_where_the_critic_learns_from_them() {
        let mut config = Config::default();
        config.behavior.start_share = 0.5;
        let numbers = |width: i64| {
            let rows = Tensor::arange(24, (Kind::Float, tch::Device::Cpu)).view([4, 6, 1]);
            rows.expand([4, 6, width], false).contiguous()
        };
        let latent = || crate::rssm::Latent {
            stoch: numbers(2),
            deter: numbers(3),
        };
        let replayed = Replayed {
            states: State {
                controllable: latent(),
                noncontrollable: latent(),
            },
            rewards: numbers(1).squeeze_dim(-1),
            discounts: numbers(1).squeeze_dim(-1),
        };
        assert!(starts(&replayed, &config).had.is_none());
        config.behavior.replay_value_scale = 0.3;
        let starts = starts(&replayed, &config);
        assert_eq!(starts.rows(), 12);
        let [whole, halves] = [12, 7].map(|rows| starts.parts(rows));
        assert_eq!([whole.len(), halves.len()], [1, 2]);
        for part in whole.into_iter().chain(halves) {
            let (rewards, _) = part.had.expect("what was had");
            let first = part.states.controllable.stoch.select(1, 0);
            assert_eq!(first, rewards.flatten(0, 1));
            assert_eq!(rewards.size()[1], 6);
        }
    }

    #[test]
    fn a_share_of_the_actions_is_the_mode() {
        let mean = Tensor::from_slice(&[0.1_f32, 0.2, 0.3, 0.4]).view([4, 1]);
        let distribution = TruncatedNormal {
            std: mean.full_like(0.5),
            mean,
        };
        for (share, greedy) in [(0.0, 0), (0.5, 2), (1.0, 4)] {
            let actions = greedy_in_part(&distribution, share);
            let is_mode = actions.eq_tensor(&distribution.mode());
            let wanted: Vec<bool> = (0..4).map(|row| row < greedy).collect();
            assert_eq!(Vec::<bool>::try_from(is_mode.view([-1])).unwrap(), wanted);
        }
    }

    #[test]
    fn the_range_of_returns_leaves_outliers_out() {
        // 0, 1, .., 100 in any order, two of them far away.
        let mut numbers: Vec<f32> = (0..101).map(|n| ((n * 37) % 101) as f32).collect();
        numbers[0] = -1e6;
        let returns = Tensor::from_slice(&numbers);
        assert_eq!(return_range(&returns).double_value(&[]), 90.0);
    }
}
