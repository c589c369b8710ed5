//! The ids of the highway.

use isodream_core::EnvSpec;
use isodream_core::config::EnvConfig;

use super::{Highway, MAX_VEHICLES, Scene};
use crate::id::EnvId;
use crate::registry::{Family, require};
use crate::{EnvError, Environment};

/// `highway/day`, `highway/straight/night` and the like.
pub(crate) const HIGHWAY: Family = Family {
    name: "highway",
    frames_per_s: 20.0,
    worlds: || {
        let ids = Scene::NAMES.into_iter();
        ids.map(str::to_owned).collect()
    },
    action_dim,
    make,
};

fn action_dim(_: EnvId<'_>, config: &EnvConfig) -> Result<usize, EnvError> {
    let vehicles = config.vehicles;
    require(
        vehicles <= MAX_VEHICLES,
        "vehicles",
        &vehicles,
        "at most 60",
    )?;
    Ok(Highway::ACTION_DIM)
}

fn make(
    id: EnvId<'_>,
    config: &EnvConfig,
    spec: EnvSpec,
) -> Result<Box<dyn Environment>, EnvError> {
    let scene = Scene::named(&id.inner()).ok_or_else(|| id.unknown())?;
    Ok(Box::new(Highway::new(config, spec, scene)))
}
