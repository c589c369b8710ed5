//! Episodes of real frames.

use anyhow::Context;
use isodream_core::config::EnvConfig;
use isodream_core::{EnvSpec, Step, Steps};
use isodream_envs::make;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::part::Work;

/// What the sequences are of: the environment's pictures, beside as many actions as the benchmark wants.
pub(super) fn spec(work: &Work) -> anyhow::Result<EnvSpec> {
    let spec = isodream_envs::spec(&config(work)).context("--environment")?;
    Ok(EnvSpec {
        action_dim: work.action_dim,
        ..spec
    })
}

/// Some episodes of `work.episode_steps` steps each, under a random driver that changes its mind every fifth step.
pub(super) fn episodes(work: &Work) -> anyhow::Result<Vec<Steps>> {
    let mut env = make(&config(work))?;
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    (0..work.episodes)
        .map(|seed| {
            let mut steps = Steps::new(env.spec().image.bytes(), work.action_dim);
            let mut driven = vec![0.0; env.spec().action_dim];
            let mut transition = env.reset(seed)?;
            loop {
                let index = steps.len;
                steps.push(&Step {
                    image: transition.image,
                    action: (0..work.action_dim).map(|_| rng.random()).collect(),
                    reward: transition.reward,
                    discount: transition.discount,
                    is_first: index == 0,
                    is_last: index + 1 == work.episode_steps,
                    is_terminal: false,
                });
                if steps.len == work.episode_steps {
                    return Ok(steps);
                }
                // A crash ends the drive, not the benchmark's episode: only frames count here.
                if transition.is_last {
                    transition = env.reset(rng.random())?;
                    continue;
                }
                if index.is_multiple_of(5) {
                    driven.fill_with(|| rng.random_range(-1.0..1.0));
                }
                transition = env.step(&driven)?;
            }
        })
        .collect()
}

fn config(work: &Work) -> EnvConfig {
    let control = work.environment.starts_with("dmc/");
    EnvConfig {
        id: work.environment.clone(),
        image_size: work.image_size,
        action_repeat: if control { 2 } else { 4 },
        time_limit: work.episode_steps as u32 + 1,
        ..EnvConfig::default()
    }
}
