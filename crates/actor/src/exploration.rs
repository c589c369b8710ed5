//! Random actions of a collecting actor: all of them before there is a policy, some of them afterwards.

use isodream_core::config::{ActorConfig, Prefill};
use isodream_core::derive_seed;
use isodream_envs::{Driver, EnvError, Environment, RandomDriver, WanderDriver};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Steps of a stretch of random actions.
const STRETCH: u32 = 15;

/// Random actions of one environment.
pub(crate) struct Exploration {
    prefill: Box<dyn Driver>,
    wander: WanderDriver,
    /// How likely a stretch of random actions begins at a step.
    begins: f64,
    steps_left: u32,
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
            rng: ChaCha8Rng::seed_from_u64(stream("when")),
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
