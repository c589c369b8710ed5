//! The ids of the Control Suite.

use std::path::PathBuf;

use isodream_core::EnvSpec;
use isodream_core::config::{BackgroundOrder, EnvConfig};

use super::environment::ControlEnvironment;
use super::{ControlTask, Recolour};
use crate::backgrounds::{BackgroundPlayer, BackgroundSource, Backgrounds, VideoOrder, VideoSet};
use crate::id::EnvId;
use crate::registry::Family;
use crate::{EnvError, Environment};

/// `dmc/walker_walk`, `dmc/walker_walk/video_easy` and `dmc/walker_walk/video_hard`, and so on for all tasks.
pub(crate) const CONTROL: Family = Family {
    name: "dmc",
    worlds: || {
        super::ids()
            .flat_map(|task| VARIANTS.map(|(variant, _)| format!("{task}{variant}")))
            .collect()
    },
    action_dim: |id, _| Ok(super::entry(id.world)?.actions),
    make,
};

/// What DMC-GB colours as its chroma key, and the patterns that take its place.
const VARIANTS: [(&str, Option<(Recolour, VideoSet)>); 3] = [
    ("", None),
    ("/video_easy", Some((Recolour::Skybox, VideoSet::Easy))),
    (
        "/video_hard",
        Some((Recolour::SkyboxAndGrid, VideoSet::Hard)),
    ),
];

fn make(
    id: EnvId<'_>,
    config: &EnvConfig,
    spec: EnvSpec,
) -> Result<Box<dyn Environment>, EnvError> {
    let task = ControlTask::load(id.world)?;
    let variant = VARIANTS
        .iter()
        .find(|(name, _)| name.strip_prefix('/') == id.variant)
        .and_then(|(_, variant)| *variant);
    let player = match variant {
        Some((_, set)) => Some(player(set, config)?),
        None => None,
    };
    let recolour = variant.map_or(Recolour::None, |(recolour, _)| recolour);
    let environment = ControlEnvironment::new(spec, config.repeat_reward, task, recolour, player)?;
    Ok(Box::new(environment))
}

fn player(set: VideoSet, config: &EnvConfig) -> Result<BackgroundPlayer, EnvError> {
    let source = if config.backgrounds.is_empty() {
        BackgroundSource::Procedural(set)
    } else {
        BackgroundSource::Folder(PathBuf::from(&config.backgrounds))
    };
    let order = match config.background_order {
        BackgroundOrder::Seeded => VideoOrder::Seeded,
        BackgroundOrder::Sequential => VideoOrder::Sequential(0),
    };
    let size = config.image_size;
    Ok(BackgroundPlayer::new(
        Backgrounds::shared(&source, size, size)?,
        order,
    ))
}
