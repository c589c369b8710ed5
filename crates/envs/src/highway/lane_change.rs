//! Lane changes of the traffic: MOBIL (Kesting et al. 2007) without politeness.

use crate::highway::car::Car;
use crate::highway::column::{Column, Neighbour};
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

/// The lane that the driver of `cars[me]` wants to change to. `column` starts with the bodies of `cars`.
pub(crate) fn decide(road: &Road, cars: &[Car], column: &Column, me: usize) -> Option<usize> {
    let car = &cars[me];
    if car.is_changing_lane() || car.speed < LEAST_SPEED_M_S {
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
        let leader = column.ahead_of(road, me, 1 << lane, None);
        let follower = column.behind(road, me, 1 << lane);
        let narrow = |side: Option<Neighbour>| side.is_some_and(|other| other.gap_m < LEAST_GAP_M);
        if narrow(leader) || narrow(follower) {
            continue;
        }
        let mine = acceleration(&car.temper, car.speed, leader.map(Neighbour::as_leader));
        if mine > best_acceleration && !imposes_braking(cars, car, follower) {
            best_acceleration = mine;
            best = Some(lane);
        }
    }
    best
}

fn imposes_braking(cars: &[Car], car: &Car, follower: Option<Neighbour>) -> bool {
    let Some(follower) = follower else {
        return false;
    };
    // The ego has no known temper: it is taken for a driver like the one who asks.
    let temper = cars
        .get(follower.index)
        .map_or(&car.temper, |other| &other.temper);
    let me = Leader {
        gap_m: follower.gap_m,
        speed_m_s: car.speed,
    };
    acceleration(temper, follower.speed_m_s, Some(me)) < -IMPOSED_BRAKE_M_S2
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
        let road = Map::Loop.road();
        let mut column = Column::default();
        column.arrange(road, 500.0, cars.iter().map(Car::body));
        decide(road, &cars, &column, 0)
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
