//! What the ids of the highway stand for.

use crate::highway::maps::Map;
use crate::render::Light;

/// A road, what drives on it, and the time of day.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Scene {
    pub(crate) map: Map,
    pub(crate) flow: Flow,
    pub(crate) light: Light,
}

/// How dense and how free the traffic is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Flow {
    /// Everyone drives and changes lanes as they like.
    Free,
    /// A [`Jam`](crate::highway::jam::Jam).
    Jam,
}

const SCENES: [(&str, Scene); 8] = [
    ("day", Scene::new(Map::Loop, Light::Day)),
    ("night", Scene::new(Map::Loop, Light::Night)),
    ("straight/day", Scene::new(Map::Straight, Light::Day)),
    ("straight/night", Scene::new(Map::Straight, Light::Night)),
    ("jam/day", Scene::jam(Light::Day)),
    ("jam/night", Scene::jam(Light::Night)),
    ("s_curve/day", Scene::new(Map::SCurve, Light::Day)),
    ("s_curve/night", Scene::new(Map::SCurve, Light::Night)),
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
        let flow = Flow::Free;
        Self { map, flow, light }
    }

    /// On the straight, so that nothing but the others decides what pays.
    pub(crate) const fn jam(light: Light) -> Self {
        Self {
            map: Map::Straight,
            flow: Flow::Jam,
            light,
        }
    }

    pub(crate) fn named(name: &str) -> Option<Self> {
        let found = SCENES.into_iter().find(|(known, _)| *known == name);
        found.map(|(_, scene)| scene)
    }
}
