//! Everyone on the road in the order in which they drive, so that neighbours are found without asking everyone.

use crate::highway::car::{Body, LONGEST_HALF_M};
use crate::highway::following::Leader;
use crate::highway::road::Road;

/// Bodies by index, the traffic's cars first.
#[derive(Debug, Clone, Default)]
pub(crate) struct Column {
    bodies: Vec<Body>,
    /// Indices from the last to the first on the road.
    order: Vec<usize>,
    /// Where in `order` each body is.
    ranks: Vec<usize>,
    /// How far each body is ahead of the place that the order was made around.
    ahead: Vec<f64>,
}

/// The nearest one in a direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Neighbour {
    pub(crate) index: usize,
    /// Bumper to bumper; negative where bodies overlap along the road.
    pub(crate) gap_m: f64,
    pub(crate) speed_m_s: f64,
}

impl Neighbour {
    pub(crate) fn as_leader(self) -> Leader {
        Leader {
            gap_m: self.gap_m,
            speed_m_s: self.speed_m_s,
        }
    }
}

impl Column {
    /// Takes up `bodies`, all of them around `reference_s`. Cheap if their order is nearly that of the last time.
    pub(crate) fn arrange(
        &mut self,
        road: &Road,
        reference_s: f64,
        bodies: impl Iterator<Item = Body>,
    ) {
        self.bodies.clear();
        self.bodies.extend(bodies);
        self.ahead.clear();
        let places = self
            .bodies
            .iter()
            .map(|body| road.ahead(reference_s, body.s));
        self.ahead.extend(places);
        if self.order.len() != self.bodies.len() {
            self.order = (0..self.bodies.len()).collect();
            self.ranks = vec![0; self.bodies.len()];
        }
        self.sort();
    }

    /// Insertion sort; at equal places the index decides, so that one of the two gives way and not both.
    fn sort(&mut self) {
        let key = |index: usize| (self.ahead[index], index);
        for end in 1..self.order.len() {
            let moved = self.order[end];
            let mut place = end;
            while place > 0 && key(self.order[place - 1]) > key(moved) {
                self.order[place] = self.order[place - 1];
                place -= 1;
            }
            self.order[place] = moved;
        }
        for (rank, &index) in self.order.iter().enumerate() {
            self.ranks[index] = rank;
        }
    }

    pub(crate) fn body(&self, index: usize) -> &Body {
        &self.bodies[index]
    }

    /// Replaces the lanes of a body.
    pub(crate) fn set_lanes(&mut self, index: usize, lanes: u8) {
        self.bodies[index].lanes = lanes;
    }

    /// Who is nearest ahead of body `me` in one of `lanes`, leaving out index `without`.
    pub(crate) fn ahead_of(
        &self,
        road: &Road,
        me: usize,
        lanes: u8,
        without: Option<usize>,
    ) -> Option<Neighbour> {
        let others = self.order[self.ranks[me] + 1..].iter();
        self.nearest(
            road,
            me,
            lanes,
            others.filter(|index| Some(**index) != without),
        )
    }

    /// Who is nearest behind body `me` in one of `lanes`.
    pub(crate) fn behind(&self, road: &Road, me: usize, lanes: u8) -> Option<Neighbour> {
        self.nearest(road, me, lanes, self.order[..self.ranks[me]].iter().rev())
    }

    /// The nearest of `others`, who come in the order of their middles.
    fn nearest<'a>(
        &self,
        road: &Road,
        me: usize,
        lanes: u8,
        others: impl Iterator<Item = &'a usize>,
    ) -> Option<Neighbour> {
        let mine = &self.bodies[me];
        let mut found: Option<Neighbour> = None;
        for &index in others {
            let other = &self.bodies[index];
            let distance = road.ahead(mine.s, other.s).abs();
            // A longer body whose middle is farther away may still be nearer.
            let least_gap = distance - mine.half_length - LONGEST_HALF_M;
            if found.is_some_and(|nearest| least_gap >= nearest.gap_m) {
                break;
            }
            if other.lanes & lanes == 0 {
                continue;
            }
            let gap_m = distance - mine.half_length - other.half_length;
            if found.is_none_or(|nearest| gap_m < nearest.gap_m) {
                found = Some(Neighbour {
                    index,
                    gap_m,
                    speed_m_s: other.speed,
                });
            }
        }
        found
    }

    /// Pairs of indices below `count`, smaller one first and in ascending order, whose middles were less than
    /// `within_m` apart along the road.
    pub(crate) fn close_pairs(&self, count: usize, within_m: f64, pairs: &mut Vec<(usize, usize)>) {
        pairs.clear();
        for (rank, &behind) in self.order.iter().enumerate() {
            for &before in &self.order[rank + 1..] {
                if self.ahead[before] - self.ahead[behind] > within_m {
                    break;
                }
                if behind < count && before < count {
                    pairs.push((behind.min(before), behind.max(before)));
                }
            }
        }
        pairs.sort_unstable();
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::highway::maps::Map;

    fn random_bodies(rng: &mut ChaCha8Rng, road: &Road) -> Vec<Body> {
        (0..40)
            .map(|_| Body {
                // Across the seam of the loop.
                s: road.wrap(rng.random_range(-90.0..90.0)),
                half_length: rng.random_range(1.8..LONGEST_HALF_M),
                speed: rng.random_range(0.0..20.0),
                lanes: rng.random_range(1..16),
            })
            .collect()
    }

    /// The least gap among `bodies` that share `lanes` and lie in direction `sign` of body `me`.
    fn least_gap(road: &Road, bodies: &[Body], me: usize, lanes: u8, sign: f64) -> Option<f64> {
        let mine = bodies[me];
        (bodies.iter().enumerate())
            .filter(|(index, other)| *index != me && other.lanes & lanes != 0)
            .map(|(_, other)| (road.ahead(mine.s, other.s) * sign, other.half_length))
            .filter(|(distance, _)| *distance > 0.0)
            .map(|(distance, half_length)| distance - mine.half_length - half_length)
            .min_by(f64::total_cmp)
    }

    #[test]
    fn neighbours_are_those_that_asking_everyone_finds() {
        let road = Map::Loop.road();
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let mut column = Column::default();
        for _ in 0..20 {
            let bodies = random_bodies(&mut rng, road);
            column.arrange(road, 0.0, bodies.iter().copied());
            for me in 0..bodies.len() {
                for lanes in [0b0001, 0b0110, 0b1000] {
                    let gap = |found: Option<Neighbour>| found.map(|other| other.gap_m);
                    let ahead = gap(column.ahead_of(road, me, lanes, None));
                    assert_eq!(ahead, least_gap(road, &bodies, me, lanes, 1.0));
                    let behind = gap(column.behind(road, me, lanes));
                    assert_eq!(behind, least_gap(road, &bodies, me, lanes, -1.0));
                }
            }
        }
    }

    #[test]
    fn close_pairs_are_all_that_are_close() {
        let road = Map::Loop.road();
        let bodies = random_bodies(&mut ChaCha8Rng::seed_from_u64(9), road);
        let mut column = Column::default();
        column.arrange(road, 0.0, bodies.iter().copied());
        let mut pairs = Vec::new();
        column.close_pairs(30, 7.0, &mut pairs);
        let expected: Vec<(usize, usize)> = (0..30)
            .flat_map(|a| (a + 1..30).map(move |b| (a, b)))
            .filter(|&(a, b)| road.ahead(bodies[a].s, bodies[b].s).abs() <= 7.0)
            .collect();
        assert!(expected.len() > 20);
        assert_eq!(pairs, expected);
    }
}
