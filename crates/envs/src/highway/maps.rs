//! The roads there are: a closed loop like the paper's Town04, and an endless straight.

use std::f64::consts::TAU;
use std::sync::LazyLock;

use crate::geometry::Vec2;
use crate::highway::road::{Node, Road};

/// Which road a world lies on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Map {
    /// A closed loop of about 5 km with bends to both sides.
    Loop,
    /// A straight without end.
    Straight,
}

impl Map {
    /// The road, computed at first use.
    pub(crate) fn road(self) -> &'static Road {
        static LOOP: LazyLock<Road> = LazyLock::new(closed_loop);
        static STRAIGHT: LazyLock<Road> = LazyLock::new(straight);
        match self {
            Self::Loop => &LOOP,
            Self::Straight => &STRAIGHT,
        }
    }
}

const RADIUS_M: f64 = 760.0;
/// Order, amplitude and phase of the loop's radial waves: enough for bends to both sides, and none sharper than 200 m.
const WAVES: [(f64, f64, f64); 3] = [(2.0, 0.09, 0.6), (3.0, 0.10, 2.1), (5.0, 0.05, 4.0)];

fn closed_loop() -> Road {
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
    Road::closed(nodes, length)
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

/// Metres after which an endless road's table repeats itself: for the straight, any number would do.
const STRAIGHT_PERIOD: usize = 1_000;

fn straight() -> Road {
    endless(STRAIGHT_PERIOD, |_| 0.0)
}

/// The endless road that repeats `period_m` metres of `curvature` (per metre, over metres).
fn endless(period_m: usize, curvature: impl Fn(f64) -> f64) -> Road {
    const FINE: usize = 100;
    let step = 1.0 / FINE as f64;
    let mut position = Vec2::default();
    let mut heading = 0.0;
    let mut nodes = Vec::with_capacity(period_m);
    for node in 0..period_m {
        nodes.push(Node {
            position,
            tangent: Vec2::from_angle(heading),
            heading,
            curvature: curvature(node as f64),
        });
        for part in 0..FINE {
            let turn = step * curvature(node as f64 + (part as f64 + 0.5) * step);
            position = position + Vec2::from_angle(heading + 0.5 * turn) * step;
            heading += turn;
        }
    }
    debug_assert!(
        heading.abs() < 1e-9,
        "a period must end in its first direction"
    );
    Road::endless(nodes, position)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::highway::road::Frenet;

    fn curvatures(map: Map) -> Vec<f64> {
        let road = map.road();
        (0..road.length() as usize)
            .map(|s| road.curvature(s as f64))
            .collect()
    }

    fn sharpest(map: Map) -> (f64, f64) {
        let curvatures = curvatures(map).into_iter();
        curvatures.fold((0.0, 0.0), |(left, right), curvature| {
            (curvature.max(left), curvature.min(right))
        })
    }

    #[test]
    fn bends_of_the_loop_go_both_ways_and_none_is_sharp() {
        let (left, right) = sharpest(Map::Loop);
        assert!((1.0 / 400.0..1.0 / 200.0).contains(&left), "{left}");
        assert!((-1.0 / 200.0..-1.0 / 800.0).contains(&right), "{right}");
    }

    #[test]
    fn the_straight_is_straight() {
        let road = Map::Straight.road();
        for s in [3.3, 999.9, 1_000.2, 123_456.7, -2_000.4] {
            let place = road.to_world(Frenet { s, d: 2.0 });
            assert!((place - Vec2::new(s, 2.0)).norm() < 1e-6, "{place:?}");
        }
    }

    #[test]
    fn no_road_has_a_kink_where_its_table_begins_again() {
        for map in [Map::Loop, Map::Straight] {
            let road = map.road();
            for d in [-7.0, 0.0, 7.0] {
                for round in [0.0, 1.0, 2.0] {
                    let seam = road.wrap(round * road.length());
                    let at = |s: f64| road.to_world(Frenet { s: road.wrap(s), d });
                    let (before, after) = (at(seam - 1e-6), at(seam + 1e-6));
                    assert!((after - before).norm() < 1e-4, "{map:?} {round}");
                    let bend = road.tangent(seam - 1e-6).cross(road.tangent(seam + 1e-6));
                    assert!(bend.abs() < 1e-4, "{map:?} {round}");
                }
            }
        }
    }
}
