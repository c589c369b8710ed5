//! Environments by id.

use std::sync::LazyLock;

use isodream_core::config::EnvConfig;
use isodream_core::{EnvSpec, ImageShape};

use crate::highway::family::HIGHWAY;
use crate::id::{EnvId, unknown};
use crate::{EnvError, Environment, GaussianNoise, Guard, Noisy};

type Make = fn(EnvId<'_>, &EnvConfig, EnvSpec) -> Result<Box<dyn Environment>, EnvError>;

/// Worlds that are made alike. Another family is another row of [`FAMILIES`].
pub(crate) struct Family {
    /// First part of its ids.
    pub(crate) name: &'static str,
    /// Frames per simulated second, one for each repetition of an action.
    pub(crate) frames_per_s: f64,
    /// Its ids without the first part, in the order they are listed in.
    pub(crate) worlds: fn() -> Vec<String>,
    /// Dimensions of the action, after checking what only this family knows; the id is one of its own.
    pub(crate) action_dim: fn(EnvId<'_>, &EnvConfig) -> Result<usize, EnvError>,
    /// Makes the world whose spec was found valid.
    pub(crate) make: Make,
}

const FAMILIES: &[&Family] = &[
    &HIGHWAY,
    #[cfg(feature = "mujoco")]
    &crate::dmc::CONTROL,
];

static IDS: LazyLock<Vec<String>> = LazyLock::new(|| {
    let ids = FAMILIES.iter().map(|family| {
        let worlds = (family.worlds)().into_iter();
        worlds.map(|world| format!("{}/{world}", family.name))
    });
    ids.flatten().collect()
});

static NAMES: LazyLock<Vec<&str>> = LazyLock::new(|| IDS.iter().map(String::as_str).collect());

/// The ids that [`make`] knows.
pub fn ids() -> &'static [&'static str] {
    &NAMES
}

/// Makes the environment that `config` describes. Its rows are checked ([`Guard`]).
///
/// # Errors
/// If the id is unknown (its nearest known ids are named) or a value is out of range.
pub fn make(config: &EnvConfig) -> Result<Box<dyn Environment>, EnvError> {
    let (family, id) = find(&config.id)?;
    let env = (family.make)(id, config, spec(config)?)?;
    Ok(Box::new(Guard::new(with_noise(env, config)?)))
}

/// The highway that `config` describes, without pictures: images are empty, and all else is as [`make`] makes it. For
/// drivers that look at the world itself.
///
/// # Errors
/// As [`make`]; if the id is none of the highway's.
pub fn make_without_pictures(config: &EnvConfig) -> Result<Box<dyn Environment>, EnvError> {
    let (family, id) = find(&config.id)?;
    if family.name != HIGHWAY.name {
        return Err(EnvError::NoPrivilegedView {
            id: config.id.clone(),
        });
    }
    let mut spec = spec(config)?;
    (spec.image.height, spec.image.width) = (0, 0);
    Ok(Box::new(Guard::new((family.make)(id, config, spec)?)))
}

/// `env` behind the noise that `config` asks for.
pub(crate) fn with_noise(
    env: Box<dyn Environment>,
    config: &EnvConfig,
) -> Result<Box<dyn Environment>, EnvError> {
    if config.noise_std == 0.0 {
        return Ok(env);
    }
    let noise = GaussianNoise {
        sigma: config.noise_std,
        target: config.noise_target,
    };
    Ok(Box::new(Noisy::new(env, noise)?))
}

/// The spec of the environment that `config` describes, without making it.
///
/// # Errors
/// As [`make`].
pub fn spec(config: &EnvConfig) -> Result<EnvSpec, EnvError> {
    let (family, id) = find(&config.id)?;
    let size = config.image_size;
    require(
        (8..=1024).contains(&size),
        "image_size",
        &size,
        "between 8 and 1024",
    )?;
    let repeat = config.action_repeat;
    require(repeat >= 1, "action_repeat", &repeat, "at least 1")?;
    let limit = config.time_limit;
    require(limit >= 1, "time_limit", &limit, "at least 1")?;
    Ok(EnvSpec {
        id: config.id.clone(),
        image: ImageShape {
            height: size,
            width: size,
            channels: 3,
        },
        action_dim: (family.action_dim)(id, config)?,
        action_repeat: repeat,
        time_limit: limit,
    })
}

/// Agent steps per simulated second, at least 1: the pace at which a film of an episode looks right. Worlds of other
/// processes do not tell theirs and are taken for 20 frames per second.
pub fn steps_per_s(id: &str, action_repeat: u32) -> f64 {
    let frames_per_s = find(id).map_or(20.0, |(family, _)| family.frames_per_s);
    (frames_per_s / f64::from(action_repeat)).max(1.0)
}

fn find(id: &str) -> Result<(&'static Family, EnvId<'_>), EnvError> {
    let known = ids().contains(&id).then(|| EnvId::parse(id)).flatten();
    let family = |id: &EnvId<'_>| FAMILIES.iter().find(|family| family.name == id.family);
    known
        .and_then(|parsed| Some((*family(&parsed)?, parsed)))
        .ok_or_else(|| unknown(id, ids()))
}

/// Refuses a `value` of the configuration's `field` unless it `holds` what is `expected`.
pub(crate) fn require(
    holds: bool,
    field: &'static str,
    value: &impl ToString,
    expected: &'static str,
) -> Result<(), EnvError> {
    if holds {
        return Ok(());
    }
    Err(EnvError::InvalidConfig {
        field,
        value: value.to_string(),
        expected,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_id(id: &str) -> EnvConfig {
        EnvConfig {
            id: id.into(),
            ..EnvConfig::default()
        }
    }

    #[test]
    fn every_listed_id_is_made_under_its_own_name() {
        for id in ids() {
            let env = make(&with_id(id)).unwrap();
            assert_eq!(env.spec(), &spec(&with_id(id)).unwrap());
            assert_eq!(env.spec().id, *id);
        }
        let mut sorted = ids().to_vec();
        sorted.sort_unstable();
        sorted.dedup();
        assert_eq!(sorted.len(), ids().len(), "an id is listed twice");
    }

    #[test]
    fn noise_is_a_setting() {
        let clean = make(&with_id("highway/day")).unwrap().reset(3).unwrap();
        let noisy = |noise_std| {
            make(&EnvConfig {
                noise_std,
                ..with_id("highway/day")
            })
        };
        let shown = noisy(10.0).unwrap().reset(3).unwrap();
        let pairs = shown.image.iter().zip(&clean.image);
        let squares: f64 = pairs
            .map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2))
            .sum();
        let std = (squares / clean.image.len() as f64).sqrt();
        // Dark and bright channels are clipped.
        assert!((8.0..10.5).contains(&std), "{std}");
        assert!(noisy(-1.0).is_err() && noisy(f32::NAN).is_err());
    }

    #[test]
    fn an_unknown_id_names_its_nearest() {
        for id in ["highway/nihgt", "highway/night/x", "night", ""] {
            let error = make(&with_id(id)).err().unwrap();
            assert!(error.to_string().contains("highway/night"), "{id}: {error}");
            assert!(error.to_string().contains("isodream env list"), "{error}");
        }
    }
}
