//! Stable names of environments: `family/world` or `family/world/variant`.

use crate::EnvError;
use crate::registry::ids;

/// A name in its parts, for example `highway/night` or `dmc/walker_walk/video_easy`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct EnvId<'a> {
    /// Who makes it, for example `highway`.
    pub(crate) family: &'a str,
    /// The map, time of day or task.
    pub(crate) world: &'a str,
    /// What is changed in it, for example its background.
    pub(crate) variant: Option<&'a str>,
}

impl<'a> EnvId<'a> {
    /// Splits `id`, or `None` where it does not have two or three parts that are not empty.
    pub(crate) fn parse(id: &'a str) -> Option<Self> {
        let mut parts = id.split('/');
        let (family, world, variant) = (parts.next()?, parts.next()?, parts.next());
        let is_whole = parts.next().is_none()
            && [Some(family), Some(world), variant]
                .iter()
                .flatten()
                .all(|part| !part.is_empty());
        is_whole.then_some(Self {
            family,
            world,
            variant,
        })
    }
}

impl EnvId<'_> {
    /// The id without its family.
    pub(crate) fn inner(&self) -> String {
        match self.variant {
            Some(variant) => format!("{}/{variant}", self.world),
            None => self.world.to_owned(),
        }
    }

    /// That nothing is made of this id.
    pub(crate) fn unknown(&self) -> EnvError {
        unknown(&format!("{}/{}", self.family, self.inner()), ids())
    }
}

/// That `id` is none of `known`.
pub(crate) fn unknown(id: &str, known: &[&str]) -> EnvError {
    EnvError::UnknownId {
        id: id.to_owned(),
        nearest: nearest(id, known).join(", "),
    }
}

/// The (at most) three of `known` that `id` is most likely meant to be, best first. A part that was left out
/// counts little: `walker_walk` is close to `dmc/walker_walk`.
fn nearest<'a>(id: &str, known: &[&'a str]) -> Vec<&'a str> {
    let distance = |candidate: &str| {
        let inner = candidate
            .split_once('/')
            .map_or(candidate, |(_, rest)| rest);
        let whole = strsim::damerau_levenshtein(candidate, id);
        whole.min(1 + strsim::damerau_levenshtein(inner, id))
    };
    let mut sorted = known.to_vec();
    sorted.sort_by_key(|candidate| distance(candidate));
    sorted.truncate(3);
    sorted
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_have_two_or_three_parts() {
        let id = EnvId::parse("dmc/walker_walk/video_easy").unwrap();
        assert_eq!(
            (id.family, id.world, id.variant),
            ("dmc", "walker_walk", Some("video_easy"))
        );
        assert_eq!(EnvId::parse("highway/night").unwrap().variant, None);
        for bad in [
            "", "highway", "highway/", "/night", "a/b/", "a/b/c/d", "a//c",
        ] {
            assert_eq!(EnvId::parse(bad), None, "{bad}");
        }
    }

    #[test]
    fn the_nearest_ids_come_first() {
        let known = [
            "dmc/cheetah_run",
            "dmc/walker_run",
            "dmc/walker_walk",
            "dmc/walker_walk/video_easy",
            "highway/day",
        ];
        assert_eq!(
            nearest("dmc/walker_wlak", &known)[..2],
            ["dmc/walker_walk", "dmc/walker_run"]
        );
        assert_eq!(nearest("walker_walk", &known)[0], "dmc/walker_walk");
        assert_eq!(
            nearest("walker_walk/video_eazy", &known)[0],
            "dmc/walker_walk/video_easy"
        );
        assert_eq!(nearest("higway/day", &known)[0], "highway/day");
        assert_eq!(nearest("x", &known).len(), 3);
    }
}
