//! What the ids of the highway stand for.

use crate::highway::maps::Map;
use crate::render::Light;

/// A road and the time of day.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Scene {
    pub(crate) map: Map,
    pub(crate) light: Light,
}

const SCENES: [(&str, Scene); 4] = [
    ("day", Scene::new(Map::Loop, Light::Day)),
    ("night", Scene::new(Map::Loop, Light::Night)),
    ("straight/day", Scene::new(Map::Straight, Light::Day)),
    ("straight/night", Scene::new(Map::Straight, Light::Night)),
];

impl Scene {
    /// The names that [`Self::named`] knows: ids without their family.
    pub(crate) const NAMES: [&'static str; SCENES.len()] = {
        let mut ids = [""; SCENES.len()];
        let mut index = 0;
        while index < ids.len() {
            ids[index] = SCENES[index].0;
            index += 1;
        }
        ids
    };

    pub(crate) const fn new(map: Map, light: Light) -> Self {
        Self { map, light }
    }

    pub(crate) fn named(name: &str) -> Option<Self> {
        let found = SCENES.into_iter().find(|(known, _)| *known == name);
        found.map(|(_, scene)| scene)
    }
}
