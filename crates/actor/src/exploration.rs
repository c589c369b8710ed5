//! How a collecting actor departs from samples of its policy: random actions before there is one and at times later on,
//! and episodes of the most likely actions.

use isodream_core::config::{ActorConfig, Prefill};
use isodream_core::derive_seed;
use isodream_envs::{Driver, EnvError, Environment, RandomDriver, WanderDriver};
use isodream_model::Actions;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Steps of a stretch of random actions.
const STRETCH: u32 = 15;

/// The choices for one environment.
pub(crate) struct Exploration {
    prefill: Box<dyn Driver>,
    wander: WanderDriver,
    /// How likely a stretch of random actions begins at a step.
    begins: f64,
    steps_left: u32,
    greedy_share: f64,
    greedy: bool,
    rng: ChaCha8Rng,
}

impl Exploration {
    /// As `config` says, for the environment number `index` of a process whose randomness is `seed`.
    pub(crate) fn new(config: &ActorConfig, seed: u64, index: usize) -> Self {
        let stream = |name: &str| derive_seed(seed, &["explore", name, &index.to_string()]);
        let share = config.explore_share;
        Self {
            prefill: match config.prefill {
                Prefill::Random => Box::new(RandomDriver::new(stream("prefill"))),
                Prefill::Wander => Box::new(WanderDriver::new(stream("prefill"))),
            },
            wander: WanderDriver::new(stream("wander")),
            // Of every 1 / begins + STRETCH steps, STRETCH are random.
            begins: if share < 1.0 {
                (share / ((1.0 - share) * f64::from(STRETCH))).min(1.0)
            } else {
                1.0
            },
            steps_left: 0,
            greedy_share: config.greedy_share,
            greedy: false,
            rng: ChaCha8Rng::seed_from_u64(stream("when")),
        }
    }

    /// An episode begins.
    pub(crate) fn begin(&mut self) {
        self.greedy = self.rng.random_bool(self.greedy_share);
    }

    /// How the policy's action is taken in this episode.
    pub(crate) fn actions(&self) -> Actions {
        if self.greedy {
            Actions::Mode
        } else {
            Actions::Sample
        }
    }

    /// The action before there is a policy.
    pub(crate) fn prefill(&mut self, env: &dyn Environment) -> Result<Vec<f32>, EnvError> {
        self.prefill.act(env)
    }

    /// A random action in place of the policy's, in some of the steps.
    pub(crate) fn instead(&mut self, env: &dyn Environment) -> Result<Option<Vec<f32>>, EnvError> {
        if self.steps_left == 0 && self.rng.random_bool(self.begins) {
            self.steps_left = STRETCH;
        }
        if self.steps_left == 0 {
            return Ok(None);
        }
        self.steps_left -= 1;
        self.wander.act(env).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use isodream_core::config::EnvConfig;

    use super::*;

    fn exploration(explore_share: f64, greedy_share: f64) -> Exploration {
        let config = ActorConfig {
            explore_share,
            greedy_share,
            ..ActorConfig::default()
        };
        Exploration::new(&config, 1, 0)
    }

    #[test]
    fn random_actions_come_in_stretches_and_have_their_share() {
        let env = isodream_envs::make_without_pictures(&EnvConfig::default()).unwrap();
        let drawn = |share: f64| -> Vec<bool> {
            let mut exploration = exploration(share, 0.0);
            let mut step = || exploration.instead(env.as_ref()).unwrap().is_some();
            (0..20_000).map(|_| step()).collect()
        };
        assert!(!drawn(0.0).contains(&true));
        assert!(!drawn(1.0).contains(&false));
        let drawn = drawn(0.2);
        let random = drawn.iter().filter(|&&random| random).count() as f64;
        assert!((random / drawn.len() as f64 - 0.2).abs() < 0.03, "{random}");
        // Stretches may follow each other; the last one may be cut off.
        let stretches = drawn.split(|&random| !random).map(<[bool]>::len);
        let (all, cut) = (stretches.clone().count(), STRETCH as usize);
        assert!(stretches.take(all - 1).all(|steps| steps % cut == 0));
    }

    #[test]
    fn whole_episodes_are_greedy_and_have_their_share() {
        let greedy = |share: f64| -> usize {
            let mut exploration = exploration(0.0, share);
            let mut episode = || {
                exploration.begin();
                exploration.actions() == Actions::Mode
            };
            (0..2_000).filter(|_| episode()).count()
        };
        assert_eq!([greedy(0.0), greedy(1.0)], [0, 2_000]);
        let some = greedy(0.3);
        assert!((540..660).contains(&some), "{some}");
    }
}
