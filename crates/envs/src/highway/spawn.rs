//! Where cars appear: around the ego at the start, and at the far ends of its surroundings later on.

use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use crate::highway::car::Car;
use crate::highway::ego;
use crate::highway::road::{LANES, Road};
use crate::highway::traffic::EgoBody;
use crate::highway::waves::Waves;

/// Cars start no farther from the ego than this, unless they are too many.
const START_WITHIN_M: f64 = 60.0;
/// They roll from the start, so that nobody waits for a queue to set off.
const ROLLING_M_S: f64 = 4.0;
/// Room for those behind the ego to brake, as it starts at rest.
const BEHIND_EGO_M: f64 = 8.0;
/// A car outside of this window around the ego is replaced by another one at the other end.
const BEHIND_M: f64 = 120.0;
const AHEAD_M: f64 = 200.0;
/// Depth of the strips at both ends in which cars appear: too far away to be seen popping up.
const STRIP_M: f64 = 20.0;

/// `count` cars that roll, dealt to the four lanes before and behind `s`.
pub(crate) fn initial(
    road: &Road,
    rng: &mut ChaCha8Rng,
    count: usize,
    s: f64,
    ego_lane: usize,
) -> Vec<Car> {
    let mut places: Vec<(usize, f64)> = (0..LANES)
        .flat_map(|lane| [(lane, 1.0), (lane, -1.0)])
        .collect();
    places.shuffle(rng);
    let mut cars = Vec::with_capacity(count);
    for (index, &(lane, side)) in places.iter().enumerate() {
        let share = (count + places.len() - 1 - index) / places.len();
        let room = match (lane == ego_lane, side > 0.0) {
            (true, true) => ego::LENGTH / 2.0,
            (true, false) => ego::LENGTH / 2.0 + BEHIND_EGO_M,
            (false, _) => 0.0,
        };
        let mut row: Vec<Car> = (0..share).map(|_| Car::random(rng, lane, 0.0)).collect();
        place_row(road, rng, &mut row, s, side, room);
        cars.append(&mut row);
    }
    cars
}

/// Spreads `row` over one side of `s`: the slack between the cars is cut at random places.
fn place_row(road: &Road, rng: &mut ChaCha8Rng, row: &mut [Car], s: f64, side: f64, room: f64) {
    let gap = |car: &Car| car.temper.gap_m + car.temper.headway_s * ROLLING_M_S;
    let taken: f64 = row
        .iter()
        .map(|car| 2.0 * car.half_length() + gap(car))
        .sum();
    let slack = (START_WITHIN_M - room - taken).max(0.0);
    let mut cuts: Vec<f64> = row
        .iter()
        .map(|_| rng.random_range(0.0..1.0) * slack)
        .collect();
    cuts.sort_by(f64::total_cmp);
    let first = row.first().map_or(0.0, gap);
    // Half a gap, so that the rows on both sides of `s` keep a whole one.
    let mut next = room + first / 2.0;
    if room > 0.0 {
        next += first / 2.0;
    }
    for (car, cut) in row.iter_mut().zip(cuts) {
        car.at.s = road.wrap(s + side * (next + cut + car.half_length()));
        next += 2.0 * car.half_length() + gap(car);
        car.speed = ROLLING_M_S;
    }
}

/// Replaces cars that left the window around `reference_s` by new ones at its other end.
pub(crate) fn recycle(
    road: &Road,
    rng: &mut ChaCha8Rng,
    waves: &Waves,
    cars: &mut [Car],
    reference_s: f64,
    ego: Option<&EgoBody>,
) {
    for index in 0..cars.len() {
        let ahead = road.ahead(reference_s, cars[index].at.s);
        let side = if ahead > AHEAD_M {
            -BEHIND_M
        } else if ahead < -BEHIND_M {
            AHEAD_M
        } else {
            continue;
        };
        let inward = rng.random_range(0.0..STRIP_M) * -side.signum();
        let lane = rng.random_range(0..LANES);
        let fresh = Car::random(rng, lane, road.wrap(reference_s + side + inward));
        // A full lane is tried again in the next frame.
        if let Some(fresh) = fit_in(road, fresh, waves, cars, index, ego) {
            cars[index] = fresh;
        }
    }
}

/// `fresh` at the speed that those around it allow, or `None` if it is too close to one of them.
fn fit_in(
    road: &Road,
    mut fresh: Car,
    waves: &Waves,
    cars: &[Car],
    replaced: usize,
    ego: Option<&EgoBody>,
) -> Option<Car> {
    let mine = fresh.body();
    let mut speed = fresh
        .temper_at(waves.pace_m_s(fresh.lane, fresh.at.s))
        .desired_m_s;
    let others = cars
        .iter()
        .enumerate()
        .filter(|(index, _)| *index != replaced)
        .map(|(_, car)| car.body())
        .chain(ego.map(|ego| ego.body));
    let mut behind = Vec::new();
    for other in others.filter(|other| other.lanes & mine.lanes != 0) {
        let distance = road.ahead(mine.s, other.s);
        let gap = distance.abs() - mine.half_length - other.half_length;
        if distance < 0.0 {
            behind.push((gap, other.speed));
            continue;
        }
        let room = gap - fresh.temper.gap_m;
        if room < 0.0 {
            return None;
        }
        // The speed from which a gentle brake still avoids this leader.
        speed = speed.min((other.speed.powi(2) + 4.0 * room).sqrt());
        if room < speed * fresh.temper.headway_s && speed > other.speed + 1.0 {
            return None;
        }
    }
    let follower_has_room = |&(gap, other_speed): &(f64, f64)| {
        let closing: f64 = (other_speed - speed).max(0.0);
        gap > 3.0 + other_speed + closing * closing / 4.0
    };
    if !behind.iter().all(follower_has_room) {
        return None;
    }
    fresh.speed = speed;
    Some(fresh)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;
    use crate::highway::collision::first_contact;
    use crate::highway::maps::Map;
    use crate::highway::road::lane_center;

    #[test]
    fn cars_start_near_the_ego_and_touch_nobody() {
        let road = Map::Loop.road();
        for seed in 0..50 {
            let ego_lane = seed as usize % LANES;
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let cars = initial(road, &mut rng, 30, 900.0, ego_lane);
            assert_eq!(cars.len(), 30);
            assert_eq!(first_contact(road, &cars), None);
            for car in &cars {
                let ahead = road.ahead(900.0, car.at.s);
                assert!(ahead.abs() + car.half_length() <= START_WITHIN_M + 2.0);
                if (car.at.d - lane_center(ego_lane)).abs() < 1.0 {
                    assert!(ahead.abs() > car.half_length() + ego::LENGTH / 2.0 + 1.0);
                }
            }
        }
    }

    #[test]
    fn more_cars_than_fit_within_forty_metres_start_farther_out() {
        let road = Map::Loop.road();
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let cars = initial(road, &mut rng, 60, 900.0, 2);
        assert_eq!(cars.len(), 60);
        assert_eq!(first_contact(road, &cars), None);
    }
}
