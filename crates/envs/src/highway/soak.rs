//! Traffic left to itself for hours: it must never collide, or an agent would be blamed for the accidents of others.

use isodream_core::derive_seed;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::EnvError;
use crate::highway::MAX_VEHICLES;
use crate::highway::ego::DT;
use crate::highway::maps::Map;
use crate::highway::traffic::Traffic;

/// Traffic is observed from a place that moves at these speeds by turns: overtaken, carried along, and overtaking.
const OBSERVER_M_S: [f64; 4] = [11.0, 4.0, 20.0, 0.0];
/// How long the place keeps a speed.
const SPEED_FOR_FRAMES: u64 = 1_200;

/// What [`traffic_without_collisions`] saw.
#[derive(Debug, Clone, PartialEq)]
pub struct TrafficReport {
    /// Simulated hours until the end or the first collision.
    pub hours: f64,
    /// Simulator frames in them.
    pub frames: u64,
    /// Mean speed of all cars.
    pub mean_speed_m_s: f64,
    /// Lane changes begun per car and hour.
    pub lane_changes_per_car_hour: f64,
    /// Indices of the first two cars that touched, in frame `frames`; `None` if there were none.
    pub collision: Option<(usize, usize)>,
}

/// Runs `vehicles` cars without an ego on the loop for `hours` simulated hours, or until two of them touch.
///
/// # Errors
/// If `hours` is not positive and finite, or if `vehicles` is beyond what an environment takes.
pub fn traffic_without_collisions(
    hours: f64,
    vehicles: u32,
    seed: u64,
) -> Result<TrafficReport, EnvError> {
    if !(hours.is_finite() && hours > 0.0) {
        return Err(EnvError::InvalidConfig {
            field: "hours",
            value: hours.to_string(),
            expected: "positive and finite",
        });
    }
    if vehicles > MAX_VEHICLES {
        return Err(EnvError::InvalidConfig {
            field: "vehicles",
            value: vehicles.to_string(),
            expected: "at most 60",
        });
    }
    let road = Map::Loop.road();
    let rng = ChaCha8Rng::seed_from_u64(derive_seed(seed, &["highway", "traffic-alone"]));
    let mut traffic = Traffic::new(road, rng, vehicles as usize, 0.0, 0);
    let mut reference = 0.0;
    let (mut frames, mut speeds, mut lane_changes) = (0, 0.0, 0_u64);
    let mut lanes: Vec<usize> = traffic.cars.iter().map(|car| car.lane).collect();
    let mut found = None;
    let end = (hours * 3_600.0 / DT).ceil() as u64;
    while frames < end && found.is_none() {
        let turn = (frames / SPEED_FOR_FRAMES) as usize % OBSERVER_M_S.len();
        reference = road.wrap(reference + OBSERVER_M_S[turn] * DT);
        traffic.step(road, reference, None);
        frames += 1;
        for (car, lane) in traffic.cars.iter().zip(&mut lanes) {
            speeds += car.speed;
            // A recycled car is in another lane without having changed to it, but then it is in its middle.
            lane_changes += u64::from(car.lane != *lane && car.is_changing_lane());
            *lane = car.lane;
        }
        found = traffic.touching;
    }
    let simulated = frames as f64 * DT / 3_600.0;
    let cars = f64::from(vehicles.max(1));
    Ok(TrafficReport {
        hours: simulated,
        frames,
        mean_speed_m_s: speeds / cars / frames as f64,
        lane_changes_per_car_hour: lane_changes as f64 / cars / simulated,
        collision: found,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn traffic_of_any_density_runs_for_minutes_without_a_collision() {
        for (vehicles, hours) in [(0, 0.05), (30, 0.5), (60, 0.2)] {
            let report = traffic_without_collisions(hours, vehicles, 3).unwrap();
            println!("{vehicles} cars: {report:?}");
            assert_eq!(report.collision, None, "{vehicles} cars: {report:?}");
            assert!((report.hours - hours).abs() < 1e-3);
            if vehicles > 0 {
                assert!(report.mean_speed_m_s > 4.5, "{report:?}");
                assert!(report.lane_changes_per_car_hour > 20.0, "{report:?}");
            }
        }
    }

    #[test]
    fn nonsense_is_refused() {
        for hours in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(traffic_without_collisions(hours, 30, 0).is_err());
        }
        assert!(traffic_without_collisions(1.0, 61, 0).is_err());
    }
}
