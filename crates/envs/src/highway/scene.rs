//! What the ids of the highway stand for.

use crate::highway::maps::Map;
use crate::render::Light;

/// A road and the time of day.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Scene {
    pub(crate) map: Map,
    pub(crate) light: Light,
}

const SCENES: [(&str, Scene); 6] = [
    ("highway/day", Scene::new(Map::Loop, Light::Day)),
    ("highway/night", Scene::new(Map::Loop, Light::Night)),
    (
        "highway/straight/day",
        Scene::new(Map::Straight, Light::Day),
    ),
    (
        "highway/straight/night",
        Scene::new(Map::Straight, Light::Night),
    ),
    ("highway/s_curve/day", Scene::new(Map::SCurve, Light::Day)),
    (
        "highway/s_curve/night",
        Scene::new(Map::SCurve, Light::Night),
    ),
];

impl Scene {
    /// The ids that [`Self::from_id`] knows.
    pub(crate) const IDS: [&'static str; SCENES.len()] = {
        let mut ids = [""; SCENES.len()];
        let mut index = 0;
        while index < ids.len() {
            ids[index] = SCENES[index].0;
            index += 1;
        }
        ids
    };

    const fn new(map: Map, light: Light) -> Self {
        Self { map, light }
    }

    pub(crate) fn from_id(id: &str) -> Option<Self> {
        let found = SCENES.into_iter().find(|(known, _)| *known == id);
        found.map(|(_, scene)| scene)
    }
}
