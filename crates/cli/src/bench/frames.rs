//! Episodes of real frames.

use isodream_core::config::EnvConfig;
use isodream_core::{Step, Steps};
use isodream_envs::make;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Some episodes of `episode_steps` steps each, under a random driver that changes its mind every fifth step; their
/// actions have `action_dim` random numbers each.
pub(super) fn episodes(
    env: &EnvConfig,
    action_dim: usize,
    episodes: u64,
    episode_steps: usize,
) -> anyhow::Result<Vec<Steps>> {
    let mut env = make(env)?;
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    (0..episodes)
        .map(|seed| {
            let mut steps = Steps::new(env.spec().image.bytes(), action_dim);
            let mut driven = vec![0.0; env.spec().action_dim];
            let mut transition = env.reset(seed)?;
            loop {
                let index = steps.len;
                steps.push(&Step {
                    image: transition.image,
                    action: (0..action_dim).map(|_| rng.random()).collect(),
                    reward: transition.reward,
                    discount: transition.discount,
                    is_first: index == 0,
                    is_last: index + 1 == episode_steps,
                    is_terminal: false,
                });
                if steps.len == episode_steps {
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

/// The chunks of an episode, at most `chunk_steps` steps each: first step and steps.
pub(super) fn chunks(
    episode: &Steps,
    chunk_steps: usize,
) -> impl Iterator<Item = (u32, Steps)> + '_ {
    (0..episode.len).step_by(chunk_steps).map(move |first| {
        let mut steps = Steps::new(episode.image_bytes, episode.action_dim);
        steps.extend(episode, first..episode.len.min(first + chunk_steps));
        (first as u32, steps)
    })
}
