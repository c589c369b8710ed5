//! The ids of the highway.

use isodream_core::EnvSpec;
use isodream_core::config::EnvConfig;

use super::Highway;
use crate::id::EnvId;
use crate::registry::{Family, require};
use crate::render::Light;
use crate::{EnvError, Environment};

/// More cars than this do not fit into the traffic's window.
const MAX_VEHICLES: u32 = 60;

/// `highway/day` and `highway/night`.
pub(crate) const HIGHWAY: Family = Family {
    name: "highway",
    worlds: || ["day", "night"].map(str::to_owned).to_vec(),
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
    let light = if id.world == "night" {
        Light::Night
    } else {
        Light::Day
    };
    Ok(Box::new(Highway::new(config, spec, light)))
}
