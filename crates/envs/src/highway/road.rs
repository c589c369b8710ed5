//! The road: four lanes along a line that is a table over arc length `s`, either a closed loop or without end.
//!
//! Lateral position `d` is 0 in the middle of the road and grows to the left; lane 0 is the rightmost.

use std::ops::Range;

use crate::geometry::Vec2;

pub(crate) const LANES: usize = 4;
pub(crate) const LANE_WIDTH: f64 = 3.5;
/// Half the width of the four lanes.
pub(crate) const LANES_HALF_WIDTH: f64 = LANES as f64 * LANE_WIDTH / 2.0;
/// Lateral position of the barriers' faces, either side. The shoulder is too narrow to pass anyone there: on one of 1.5 m,
/// full throttle without a look at the others earned more than keeping the lane with one.
pub(crate) const BARRIER_D: f64 = LANES_HALF_WIDTH + 0.5;

#[derive(Debug, Clone, Copy)]
pub(crate) struct Node {
    pub(crate) position: Vec2,
    pub(crate) tangent: Vec2,
    pub(crate) heading: f64,
    pub(crate) curvature: f64,
}

/// Road coordinates of a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Frenet {
    pub(crate) s: f64,
    pub(crate) d: f64,
}

#[derive(Debug)]
pub(crate) struct Road {
    nodes: Vec<Node>,
    spacing: f64,
    nodes_per_m: f64,
    /// Length of the table.
    length: f64,
    /// From the table's start to its end, where an endless road repeats it; `None` for a closed loop.
    period: Option<Vec2>,
}

/// On an endless road episodes start this far from its zero: the patterns of the ground are made for positive places.
const FIRST_START_M: f64 = 1_000.0;

impl Road {
    /// A loop of `length` from evenly spaced nodes.
    pub(crate) fn closed(nodes: Vec<Node>, length: f64) -> Self {
        Self::new(nodes, length, None)
    }

    /// A road that repeats `nodes`, one a metre, each time moved on by `period`.
    pub(crate) fn endless(nodes: Vec<Node>, period: Vec2) -> Self {
        let length = nodes.len() as f64;
        Self::new(nodes, length, Some(period))
    }

    fn new(nodes: Vec<Node>, length: f64, period: Option<Vec2>) -> Self {
        let spacing = length / nodes.len() as f64;
        Self {
            nodes,
            spacing,
            nodes_per_m: 1.0 / spacing,
            length,
            period,
        }
    }

    /// Length of the table: once round the loop, or one period of an endless road.
    pub(crate) fn length(&self) -> f64 {
        self.length
    }

    /// Where episodes start.
    pub(crate) fn starts(&self) -> Range<f64> {
        match self.period {
            None => 0.0..self.length,
            Some(_) => FIRST_START_M..FIRST_START_M + self.length,
        }
    }

    /// `s` as places are written: within `[0, length)` on a loop, anything on an endless road.
    pub(crate) fn wrap(&self, s: f64) -> f64 {
        // Nearly every place is inside already: this spares the renderer a division per pixel.
        if self.period.is_some() || (0.0..self.length).contains(&s) {
            return s;
        }
        s.rem_euclid(self.length)
    }

    /// How far `to` is ahead of `from`, on a loop the short way round.
    pub(crate) fn ahead(&self, from: f64, to: f64) -> f64 {
        let half = self.length / 2.0;
        let difference = to - from;
        // Nearly every pair is close: this spares the division in the traffic's inner loop.
        if self.period.is_some() || difference.abs() < half {
            return difference;
        }
        (difference + half).rem_euclid(self.length) - half
    }

    /// The node nearest to `s`, and how far `s` lies beyond it.
    #[inline]
    pub(crate) fn nearest_node(&self, s: f64) -> (Node, f64) {
        let Some(period) = self.period else {
            let (index, beyond) = self.index(self.wrap(s));
            let index = if index < self.nodes.len() { index } else { 0 };
            return (self.nodes[index], beyond);
        };
        let mut round = (s / self.length).floor();
        let (mut index, beyond) = self.index(s - round * self.length);
        if index == self.nodes.len() {
            (index, round) = (0, round + 1.0);
        }
        let mut node = self.nodes[index];
        node.position = node.position + period * round;
        (node, beyond)
    }

    /// For a place on the table: the nearest node, which may be the one after the last, and how far the place lies beyond it.
    fn index(&self, s: f64) -> (usize, f64) {
        let position = s * self.nodes_per_m;
        // Truncation rounds, as positions are not negative; `round` is a call on plain x86-64.
        let index = (position + 0.5) as usize;
        (index, (position - index as f64) * self.spacing)
    }

    pub(crate) fn heading(&self, s: f64) -> f64 {
        let (node, beyond) = self.nearest_node(s);
        node.heading + node.curvature * beyond
    }

    pub(crate) fn curvature(&self, s: f64) -> f64 {
        self.nearest_node(s).0.curvature
    }

    pub(crate) fn tangent(&self, s: f64) -> Vec2 {
        Vec2::from_angle(self.heading(s))
    }

    /// World position of a point in road coordinates.
    pub(crate) fn to_world(&self, point: Frenet) -> Vec2 {
        let (node, beyond) = self.nearest_node(point.s);
        let bend = node.curvature * beyond;
        let normal = node.tangent.left();
        // Second order in the distance from the node: below a micrometre at half the spacing.
        let centre = node.position + node.tangent * beyond + normal * (0.5 * bend * beyond);
        centre + (normal + node.tangent * -bend) * point.d
    }

    /// Road coordinates of `position`, found by Newton's method from a point near `guess_s`.
    pub(crate) fn project(&self, position: Vec2, guess_s: f64) -> Frenet {
        self.project_with_node(position, guess_s).0
    }

    /// As [`Self::project`], together with the node that was nearest.
    #[inline]
    pub(crate) fn project_with_node(&self, position: Vec2, guess_s: f64) -> (Frenet, Node) {
        let mut s = guess_s;
        let mut d = 0.0;
        let (mut node, mut beyond) = self.nearest_node(s);
        for _ in 0..6 {
            let offset = position - node.position;
            let across = offset.dot(node.tangent.left());
            // The lower bound keeps points beyond the centre of the bend from flipping the direction.
            let along = offset.dot(node.tangent) / (1.0 - node.curvature * across).max(MIN_STRETCH);
            d = across - 0.5 * node.curvature * along * along;
            let correction = along - beyond;
            s += correction;
            if correction.abs() < self.spacing * 0.5 {
                break;
            }
            (node, beyond) = self.nearest_node(s);
        }
        (Frenet { s: self.wrap(s), d }, node)
    }
}

const MIN_STRETCH: f64 = 0.3;

pub(crate) fn lane_center(lane: usize) -> f64 {
    (lane as f64 - (LANES as f64 - 1.0) / 2.0) * LANE_WIDTH
}

/// The lane that holds `d`; the outer lanes take in their shoulders.
pub(crate) fn lane_at(d: f64) -> usize {
    let lane = ((d + LANES_HALF_WIDTH) / LANE_WIDTH).floor();
    lane.clamp(0.0, (LANES - 1) as f64) as usize
}

/// Bit `i` is set if `[d - half_width, d + half_width]` overlaps lane `i`.
pub(crate) fn lanes_overlapped(d: f64, half_width: f64) -> u8 {
    let (first, last) = (lane_at(d - half_width), lane_at(d + half_width));
    (first..=last).fold(0, |mask, lane| mask | 1 << lane)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::highway::maps::Map;

    #[test]
    fn projection_inverts_to_world() {
        for map in [Map::Loop, Map::Straight] {
            let road = map.road();
            for i in 0..500 {
                let s = i as f64 * 9.37;
                let point = Frenet {
                    s: road.wrap(s),
                    d: (i % 17) as f64 - 8.0,
                };
                let found = road.project(road.to_world(point), road.wrap(s + 4.0));
                assert!(
                    road.ahead(point.s, found.s).abs() < 0.01,
                    "s at {s}, {map:?}"
                );
                assert!((found.d - point.d).abs() < 0.01, "d at {s}, {map:?}");
            }
        }
    }

    #[test]
    fn a_body_on_a_line_takes_up_both_lanes() {
        assert_eq!(lanes_overlapped(lane_center(1), 0.9), 0b0010);
        assert_eq!(lanes_overlapped(0.0, 0.9), 0b0110);
        assert_eq!(lanes_overlapped(-8.0, 0.4), 0b0001);
    }

    #[test]
    fn ahead_takes_the_short_way_round() {
        let road = Map::Loop.road();
        assert!((road.ahead(road.length() - 3.0, 4.0) - 7.0).abs() < 1e-9);
        assert!((road.ahead(4.0, road.length() - 3.0) + 7.0).abs() < 1e-9);
    }
}
