//! Lane changes of the traffic: MOBIL (Kesting et al. 2007) without politeness.

use crate::highway::car::{Body, Car};
use crate::highway::following::{Leader, acceleration};
use crate::highway::road::{LANES, Road};

/// Gain in acceleration that makes a change worth it.
const GAIN_M_S2: f64 = 0.2;
/// Greatest braking that a change may impose on anyone.
const IMPOSED_BRAKE_M_S2: f64 = 2.0;
/// Gap that a change leaves on both sides at the least.
const LEAST_GAP_M: f64 = 2.0;
/// A standing car cannot leave its lane.
const LEAST_SPEED_M_S: f64 = 1.0;

/// Those around a place: nearest first in each direction.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Neighbours {
    /// Index and gap; the gap is negative where bodies overlap along the road.
    pub(crate) ahead: Option<(usize, f64)>,
    pub(crate) behind: Option<(usize, f64)>,
}

/// Who of `bodies` shares one of `lanes` with a body at index `me`, leaving out index `without`.
pub(crate) fn neighbours(
    road: &Road,
    bodies: &[Body],
    me: usize,
    lanes: u8,
    without: Option<usize>,
) -> Neighbours {
    let mine = &bodies[me];
    let mut found = Neighbours::default();
    for (index, other) in bodies.iter().enumerate() {
        if index == me || other.lanes & lanes == 0 || Some(index) == without {
            continue;
        }
        let distance = road.ahead(mine.s, other.s);
        let gap = distance.abs() - mine.half_length - other.half_length;
        // At equal places the index decides, so that one of the two gives way and not both.
        let is_ahead = distance > 0.0 || distance == 0.0 && index > me;
        let slot = if is_ahead {
            &mut found.ahead
        } else {
            &mut found.behind
        };
        if slot.is_none_or(|(_, nearest)| gap < nearest) {
            *slot = Some((index, gap));
        }
    }
    found
}

/// The leader that `neighbour` is.
pub(crate) fn leader(bodies: &[Body], neighbour: Option<(usize, f64)>) -> Option<Leader> {
    neighbour.map(|(index, gap_m)| Leader {
        gap_m,
        speed_m_s: bodies[index].speed,
    })
}

/// The lane that the driver of `cars[me]` wants to change to. `bodies` starts with those of `cars`.
pub(crate) fn decide(road: &Road, cars: &[Car], bodies: &[Body], me: usize) -> Option<usize> {
    let car = &cars[me];
    if car.is_changing_lane() || car.speed < LEAST_SPEED_M_S || car.shocked_s > 0.0 {
        return None;
    }
    let candidates = [car.lane.checked_sub(1), Some(car.lane + 1)];
    let mut best = None;
    let mut best_acceleration = car.acceleration + GAIN_M_S2;
    for lane in candidates
        .into_iter()
        .flatten()
        .filter(|&lane| lane < LANES)
    {
        let around = neighbours(road, bodies, me, 1 << lane, None);
        let narrow = |side: Option<(usize, f64)>| side.is_some_and(|(_, gap)| gap < LEAST_GAP_M);
        if narrow(around.ahead) || narrow(around.behind) {
            continue;
        }
        let mine = acceleration(&car.temper, car.speed, leader(bodies, around.ahead));
        if mine > best_acceleration && !imposes_braking(cars, bodies, car, around.behind) {
            best_acceleration = mine;
            best = Some(lane);
        }
    }
    best
}

fn imposes_braking(
    cars: &[Car],
    bodies: &[Body],
    car: &Car,
    follower: Option<(usize, f64)>,
) -> bool {
    let Some((index, gap_m)) = follower else {
        return false;
    };
    // The ego has no known temper: it is taken for a driver like the one who asks.
    let temper = cars.get(index).map_or(&car.temper, |other| &other.temper);
    let me = Leader {
        gap_m,
        speed_m_s: car.speed,
    };
    acceleration(temper, bodies[index].speed, Some(me)) < -IMPOSED_BRAKE_M_S2
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::highway::maps::Map;
    use crate::highway::road::{Frenet, lane_center};

    /// The one who asks, in the rightmost lane behind a slow leader, with a follower in the next lane.
    fn wish(follower_behind_m: f64, follower_speed: f64) -> Option<usize> {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let cars: Vec<Car> = [
            (0, 500.0, 10.0),
            (0, 515.0, 5.0),
            (1, 500.0 - follower_behind_m, follower_speed),
        ]
        .into_iter()
        .map(|(lane, s, speed)| {
            let mut car = Car::random(&mut rng, lane, s);
            car.at = Frenet {
                s,
                d: lane_center(lane),
            };
            car.speed = speed;
            car.temper.desired_m_s = 16.0;
            car.acceleration = -3.0;
            car
        })
        .collect();
        let bodies: Vec<Body> = cars.iter().map(Car::body).collect();
        decide(Map::Loop.road(), &cars, &bodies, 0)
    }

    #[test]
    fn changes_into_a_free_lane() {
        assert_eq!(wish(80.0, 10.0), Some(1));
    }

    #[test]
    fn does_not_cut_off_a_fast_follower() {
        assert_eq!(wish(20.0, 16.0), None);
    }

    #[test]
    fn does_not_change_into_a_neighbour() {
        assert_eq!(wish(2.0, 10.0), None);
    }
}
