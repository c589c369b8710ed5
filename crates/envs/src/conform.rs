//! Environments that were made elsewhere, as a configuration asks for them.

use isodream_core::config::EnvConfig;
use isodream_core::{EnvSpec, ImageShape};

use crate::registry::{require, with_noise};
use crate::{ActionRepeat, EnvError, Environment, Resize, TimeLimit};

/// Makes `env` show and take what `config` says: its pictures are resized, its actions repeated until there are
/// `action_repeat` frames to one, its episodes cut at `time_limit`, and noise is added.
///
/// # Errors
/// As [`conformed_spec`], and [`EnvError::NoSegmentation`] where noise needs one.
pub fn conform(
    mut env: Box<dyn Environment>,
    config: &EnvConfig,
) -> Result<Box<dyn Environment>, EnvError> {
    let offered = env.spec().clone();
    let spec = conformed_spec(&offered, config)?;
    if spec.image != offered.image {
        env = Box::new(Resize::new(env, spec.image.height, spec.image.width));
    }
    if spec.action_repeat != offered.action_repeat {
        let repeat = spec.action_repeat / offered.action_repeat;
        env = Box::new(ActionRepeat::new(env, repeat, config.repeat_reward));
    }
    if spec.time_limit < env.spec().time_limit {
        env = Box::new(TimeLimit::new(env, spec.time_limit));
    }
    with_noise(env, config)
}

/// The spec of an environment with the spec `offered` after [`conform`].
///
/// # Errors
/// [`EnvError::InvalidConfig`] if `config.action_repeat` is not a multiple of the offered one.
pub fn conformed_spec(offered: &EnvSpec, config: &EnvConfig) -> Result<EnvSpec, EnvError> {
    let own = offered.action_repeat.max(1);
    require(
        config.action_repeat >= own && config.action_repeat.is_multiple_of(own),
        "action_repeat",
        &format!(
            "{} (the environment itself repeats {own} times)",
            config.action_repeat
        ),
        "a multiple of the environment's own",
    )?;
    let steps = offered.time_limit.div_ceil(config.action_repeat / own);
    Ok(EnvSpec {
        id: offered.id.clone(),
        image: ImageShape {
            height: config.image_size,
            width: config.image_size,
            channels: offered.image.channels,
        },
        action_dim: offered.action_dim,
        action_repeat: config.action_repeat,
        time_limit: steps.min(config.time_limit),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::Script;

    /// 2 x 2 pixels, two frames per step, nine steps.
    fn script() -> Script {
        let mut script = Script::of_length(9);
        script.spec.action_repeat = 2;
        script.spec.time_limit = 9;
        script
    }

    fn config(image_size: usize, action_repeat: u32, time_limit: u32) -> EnvConfig {
        EnvConfig {
            image_size,
            action_repeat,
            time_limit,
            ..EnvConfig::default()
        }
    }

    #[test]
    fn the_spec_is_what_the_wrappers_make() {
        for (size, repeat, limit) in [(2, 2, 100), (8, 2, 9), (2, 6, 100), (16, 4, 3)] {
            let config = config(size, repeat, limit);
            let spec = conformed_spec(&script().spec, &config).unwrap();
            let mut env = conform(script().boxed(), &config).unwrap();
            assert_eq!(env.spec(), &spec);
            assert_eq!(spec.action_repeat, repeat);
            let mut row = env.reset(1).unwrap();
            assert_eq!(row.image.len(), size * size * 3);
            let mut steps = 0;
            while !row.is_last {
                row = env.step(&[0.0]).unwrap();
                steps += 1;
            }
            assert_eq!(steps, spec.time_limit);
        }
    }

    #[test]
    fn a_repeat_that_cannot_be_made_is_refused() {
        for repeat in [1, 3] {
            let error = conform(script().boxed(), &config(2, repeat, 9))
                .err()
                .unwrap();
            assert!(error.to_string().contains("repeats 2 times"), "{error}");
        }
    }
}
