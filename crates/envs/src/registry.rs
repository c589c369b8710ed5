//! Environments by id.

use isodream_core::config::EnvConfig;
use isodream_core::{EnvSpec, ImageShape};

use crate::highway::{Highway, MAX_VEHICLES, Scene};
use crate::{EnvError, Environment};

const IDS: &[&str] = &Scene::IDS;

/// The ids that [`make`] knows.
pub fn ids() -> &'static [&'static str] {
    IDS
}

/// Makes the environment that `config` describes.
///
/// # Errors
/// If the id is unknown or a value is out of range.
pub fn make(config: &EnvConfig) -> Result<Box<dyn Environment>, EnvError> {
    let scene = scene(&config.id)?;
    Ok(Box::new(Highway::new(config, spec(config)?, scene)))
}

/// The spec of the environment that `config` describes, without making it.
///
/// # Errors
/// As [`make`].
pub fn spec(config: &EnvConfig) -> Result<EnvSpec, EnvError> {
    scene(&config.id)?;
    require(
        (8..=1024).contains(&config.image_size),
        "image_size",
        &config.image_size,
        "between 8 and 1024",
    )?;
    require(
        config.action_repeat >= 1,
        "action_repeat",
        &config.action_repeat,
        "at least 1",
    )?;
    require(
        config.time_limit >= 1,
        "time_limit",
        &config.time_limit,
        "at least 1",
    )?;
    require(
        config.vehicles <= MAX_VEHICLES,
        "vehicles",
        &config.vehicles,
        "at most 60",
    )?;
    Ok(EnvSpec {
        id: config.id.clone(),
        image: ImageShape {
            height: config.image_size,
            width: config.image_size,
            channels: 3,
        },
        action_dim: Highway::ACTION_DIM,
        action_repeat: config.action_repeat,
        time_limit: config.time_limit,
    })
}

fn scene(id: &str) -> Result<Scene, EnvError> {
    Scene::from_id(id).ok_or_else(|| EnvError::UnknownId {
        id: id.to_owned(),
        known: IDS.join(", "),
    })
}

fn require(
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
