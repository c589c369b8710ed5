//! The ids of the Control Suite.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, LazyLock, Mutex, PoisonError, Weak};

use isodream_core::EnvSpec;
use isodream_core::config::{BackgroundOrder, EnvConfig};

use super::environment::ControlEnvironment;
use super::{ControlTask, Recolour, SceneRenderer};
use crate::backgrounds::{BackgroundPlayer, BackgroundSource, Backgrounds, VideoOrder, VideoSet};
use crate::id::EnvId;
use crate::raycast::Assets;
use crate::registry::Family;
use crate::{EnvError, Environment};

/// `dmc/walker_walk`, `dmc/walker_walk/video_easy` and `dmc/walker_walk/video_hard`, and so on for all tasks.
pub(crate) const CONTROL: Family = Family {
    name: "dmc",
    frames_per_s: 50.0,
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
    let size = (spec.image.height, spec.image.width);
    let renderer = SceneRenderer::with_assets(&task, size, shared_assets(&task, recolour)?);
    let repeat = config.repeat_reward;
    let environment = ControlEnvironment::new(spec, repeat, task, renderer, player);
    Ok(Box::new(environment))
}

type Shared = Mutex<HashMap<(&'static str, Recolour), Weak<Assets>>>;

/// Textures and meshes of a task, made once per process for as long as anybody uses them.
fn shared_assets(task: &ControlTask, recolour: Recolour) -> Result<Arc<Assets>, EnvError> {
    static SHARED: LazyLock<Shared> = LazyLock::new(Mutex::default);
    let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
    let key = (task.id(), recolour);
    if let Some(assets) = shared.get(&key).and_then(Weak::upgrade) {
        return Ok(assets);
    }
    let assets = SceneRenderer::assets(task, recolour)?;
    shared.retain(|_, known| known.strong_count() > 0);
    shared.insert(key, Arc::downgrade(&assets));
    Ok(assets)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn environments_of_a_task_share_its_textures() {
        let load = |id| ControlTask::load(id).unwrap();
        let (first, second) = (load("point_mass_easy"), load("point_mass_easy"));
        let plain = shared_assets(&first, Recolour::None).unwrap();
        assert!(Arc::ptr_eq(
            &plain,
            &shared_assets(&second, Recolour::None).unwrap()
        ));
        assert!(!Arc::ptr_eq(
            &plain,
            &shared_assets(&first, Recolour::Skybox).unwrap()
        ));
        let other = shared_assets(&load("reacher_easy"), Recolour::None).unwrap();
        assert!(!Arc::ptr_eq(&plain, &other));
        let weak = Arc::downgrade(&plain);
        drop(plain);
        assert!(weak.upgrade().is_none(), "kept though nobody uses them");
    }
}
