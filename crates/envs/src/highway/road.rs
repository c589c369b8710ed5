//! The road: a closed four-lane loop with bends to both sides, as a table over arc length `s`.
//!
//! Lateral position `d` is 0 in the middle of the road and grows to the left; lane 0 is the rightmost.

use std::f64::consts::TAU;
use std::sync::LazyLock;

use crate::geometry::Vec2;

pub(crate) const LANES: usize = 4;
pub(crate) const LANE_WIDTH: f64 = 3.5;
/// Half the width of the four lanes.
pub(crate) const LANES_HALF_WIDTH: f64 = LANES as f64 * LANE_WIDTH / 2.0;
/// Lateral position of the barriers' faces, either side: lanes plus a shoulder of 1.5 m.
pub(crate) const BARRIER_D: f64 = LANES_HALF_WIDTH + 1.5;

const RADIUS_M: f64 = 760.0;
/// Order, amplitude and phase of the loop's radial waves: enough for bends to both sides, and none sharper than 200 m.
const WAVES: [(f64, f64, f64); 3] = [(2.0, 0.09, 0.6), (3.0, 0.10, 2.1), (5.0, 0.05, 4.0)];

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
    length: f64,
}

impl Road {
    /// The one road there is, computed at first use.
    pub(crate) fn shared() -> &'static Self {
        static ROAD: LazyLock<Road> = LazyLock::new(Road::new);
        &ROAD
    }

    fn new() -> Self {
        const FINE: usize = 40_000;
        let angle_step = TAU / FINE as f64;
        let speed = |theta: f64| {
            let [r, dr, _] = radius(theta);
            r.hypot(dr)
        };
        let mut arc = Vec::with_capacity(FINE + 1);
        let mut total = 0.0;
        for i in 0..=FINE {
            arc.push(total);
            total += angle_step * speed((i as f64 + 0.5) * angle_step);
        }
        let length = arc[FINE];
        let count = length.round() as usize;
        let spacing = length / count as f64;
        let mut fine = 0;
        let nodes = (0..count)
            .map(|i| {
                let s = i as f64 * spacing;
                while arc[fine + 1] <= s {
                    fine += 1;
                }
                let part = (s - arc[fine]) / (arc[fine + 1] - arc[fine]);
                node_at_angle((fine as f64 + part) * angle_step)
            })
            .collect();
        Self {
            nodes,
            spacing,
            nodes_per_m: 1.0 / spacing,
            length,
        }
    }

    pub(crate) fn length(&self) -> f64 {
        self.length
    }

    /// `s` brought into `[0, length)`.
    pub(crate) fn wrap(&self, s: f64) -> f64 {
        // Nearly every place is inside already: this spares the renderer a division per pixel.
        if (0.0..self.length).contains(&s) {
            return s;
        }
        s.rem_euclid(self.length)
    }

    /// How far `to` is ahead of `from`, the short way round.
    pub(crate) fn ahead(&self, from: f64, to: f64) -> f64 {
        let half = self.length / 2.0;
        let difference = to - from;
        // Nearly every pair is close: this spares the division in the traffic's inner loop.
        if difference.abs() < half {
            return difference;
        }
        (difference + half).rem_euclid(self.length) - half
    }

    /// The table's node nearest to `s`, and how far `s` lies beyond it.
    pub(crate) fn nearest_node(&self, s: f64) -> (&Node, f64) {
        let position = self.wrap(s) * self.nodes_per_m;
        // Truncation rounds, as positions are not negative; `round` is a call on plain x86-64.
        let index = (position + 0.5) as usize;
        let beyond = (position - index as f64) * self.spacing;
        let index = if index < self.nodes.len() { index } else { 0 };
        (&self.nodes[index], beyond)
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
    pub(crate) fn project_with_node(&self, position: Vec2, guess_s: f64) -> (Frenet, &Node) {
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

/// Radius of the loop at `theta` and its first two derivatives.
fn radius(theta: f64) -> [f64; 3] {
    let mut r = [1.0, 0.0, 0.0];
    for (order, amplitude, phase) in WAVES {
        let (sin, cos) = (order * theta + phase).sin_cos();
        r[0] += amplitude * cos;
        r[1] -= amplitude * order * sin;
        r[2] -= amplitude * order * order * cos;
    }
    r.map(|value| value * RADIUS_M)
}

fn node_at_angle(theta: f64) -> Node {
    let [r, dr, ddr] = radius(theta);
    let (sin, cos) = theta.sin_cos();
    let velocity = Vec2::new(dr * cos - r * sin, dr * sin + r * cos);
    let speed = velocity.norm();
    Node {
        position: Vec2::new(r * cos, r * sin),
        tangent: velocity * (1.0 / speed),
        heading: velocity.y.atan2(velocity.x),
        curvature: (r * r + 2.0 * dr * dr - r * ddr) / speed.powi(3),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bends_go_both_ways_and_none_is_sharp() {
        let road = Road::shared();
        let curvatures: Vec<f64> = road.nodes.iter().map(|node| node.curvature).collect();
        let most_left = curvatures.iter().copied().fold(f64::MIN, f64::max);
        let most_right = curvatures.iter().copied().fold(f64::MAX, f64::min);
        println!(
            "length {} left {} right {}",
            road.length,
            1.0 / most_left,
            1.0 / most_right
        );
        assert!((1.0 / 400.0..1.0 / 200.0).contains(&most_left));
        assert!((-1.0 / 200.0..-1.0 / 800.0).contains(&most_right));
    }

    #[test]
    fn the_loop_closes() {
        let road = Road::shared();
        let end = road.to_world(Frenet {
            s: road.length() - 1e-9,
            d: 2.0,
        });
        let start = road.to_world(Frenet { s: 0.0, d: 2.0 });
        assert!((end - start).norm() < 1e-3);
    }

    #[test]
    fn projection_inverts_to_world() {
        let road = Road::shared();
        for i in 0..500 {
            let s = i as f64 * 9.37;
            let point = Frenet {
                s: road.wrap(s),
                d: (i % 17) as f64 - 8.0,
            };
            let found = road.project(road.to_world(point), road.wrap(s + 4.0));
            assert!(road.ahead(point.s, found.s).abs() < 0.01, "s at {s}");
            assert!((found.d - point.d).abs() < 0.01, "d at {s}");
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
        let road = Road::shared();
        assert!((road.ahead(road.length() - 3.0, 4.0) - 7.0).abs() < 1e-9);
        assert!((road.ahead(4.0, road.length() - 3.0) + 7.0).abs() < 1e-9);
    }
}
