//! The highway through its public interface.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use std::collections::BTreeSet;

use isodream_core::config::{EnvConfig, RepeatReward};
use isodream_envs::{
    BEST_BLIND_PEDAL, BlindDriver, Driver, EndReason, EnvError, Environment, ScriptedDriver,
    Transition, class, ids, make, make_without_pictures, score, spec,
};
use proptest::prelude::*;

fn env(id: &str) -> Box<dyn Environment> {
    make(&EnvConfig {
        id: id.into(),
        ..EnvConfig::default()
    })
    .unwrap()
}

/// Every transition of an episode and its metrics.
fn episode(
    env: &mut dyn Environment,
    driver: ScriptedDriver,
    seed: u64,
) -> (Vec<Transition>, Vec<(&'static str, f64)>) {
    let mut driver = driver.driver(seed);
    let mut transitions = vec![env.reset(seed).unwrap()];
    while !transitions.last().unwrap().is_last {
        let action = driver.act(env).unwrap();
        transitions.push(env.step(&action).unwrap());
    }
    (transitions, env.metrics())
}

fn total(transitions: &[Transition]) -> f64 {
    transitions.iter().map(|t| f64::from(t.reward)).sum()
}

fn metric(metrics: &[(&str, f64)], name: &str) -> f64 {
    metrics.iter().find(|(other, _)| *other == name).unwrap().1
}

#[test]
fn the_same_seed_and_actions_give_the_same_bytes() {
    for id in ids().iter().filter(|id| id.starts_with("highway/")) {
        let first = episode(env(id).as_mut(), ScriptedDriver::Random, 3);
        let mut used = env(id);
        episode(used.as_mut(), ScriptedDriver::Reacting, 8);
        let again = episode(used.as_mut(), ScriptedDriver::Random, 3);
        assert_eq!(first, again, "{id}");
        let other = episode(used.as_mut(), ScriptedDriver::Random, 4);
        assert_ne!(first.0[0].image, other.0[0].image);
    }
}

#[test]
fn day_and_night_differ_in_pictures_only() {
    let (day, _) = episode(env("highway/day").as_mut(), ScriptedDriver::Reacting, 5);
    let (night, _) = episode(env("highway/night").as_mut(), ScriptedDriver::Reacting, 5);
    assert_eq!(day.len(), night.len());
    let brightness = |t: &Transition| t.image.iter().map(|&b| u64::from(b)).sum::<u64>();
    for (day, night) in day.iter().zip(&night) {
        assert_eq!(day.reward, night.reward);
        assert!(brightness(night) * 2 < brightness(day));
    }
}

#[test]
fn drifting_weather_changes_pictures_only_and_follows_from_the_seed() {
    let drifting = |id: &str| {
        make(&EnvConfig {
            id: id.into(),
            weather_drift: true,
            ..EnvConfig::default()
        })
        .unwrap()
    };
    for id in ["highway/day", "highway/night"] {
        let (fine, _) = episode(env(id).as_mut(), ScriptedDriver::Reacting, 5);
        let mut env = drifting(id);
        let (drift, _) = episode(env.as_mut(), ScriptedDriver::Reacting, 5);
        let (again, _) = episode(env.as_mut(), ScriptedDriver::Reacting, 5);
        assert_eq!(drift, again, "{id}");
        assert_eq!(drift.len(), fine.len());
        for (drift, fine) in drift.iter().zip(&fine) {
            assert_eq!(drift.reward, fine.reward);
            assert_ne!(drift.image, fine.image);
        }
    }
    let mut env = drifting("highway/straight/day");
    let mut sky = |seed| env.reset(seed).unwrap().image[..3].to_vec();
    let skies: BTreeSet<Vec<u8>> = (0..8).map(&mut sky).collect();
    assert!(skies.len() > 4, "{skies:?}");
}

#[test]
fn row_0_and_the_time_limit_follow_the_contract() {
    let (transitions, metrics) = episode(env("highway/day").as_mut(), ScriptedDriver::KeepLane, 1);
    let first = &transitions[0];
    assert_eq!((first.reward, first.discount), (0.0, 1.0));
    assert!(!first.is_last && !first.is_terminal && first.end_reason.is_none());
    assert_eq!(transitions.len(), 251);
    let last = transitions.last().unwrap();
    assert_eq!(last.end_reason, Some(EndReason::TimeLimit));
    assert!(last.is_last && !last.is_terminal);
    assert_eq!(last.discount, 1.0);
    assert!(transitions.iter().all(|t| t.image.len() == 64 * 64 * 3));
    assert_eq!(metric(&metrics, "lane_changes"), 0.0);
    assert_eq!(metric(&metrics, "collisions"), 0.0);
    assert!(metric(&metrics, "distance_m") > 200.0);
}

#[test]
fn standing_still_ends_terminally() {
    let mut env = env("highway/day");
    env.reset(1).unwrap();
    let mut steps = 0;
    let last = loop {
        steps += 1;
        let transition = env.step(&[0.0, -1.0]).unwrap();
        if transition.is_last {
            break transition;
        }
    };
    // 100 frames at 4 frames per step.
    assert_eq!(steps, 25);
    assert_eq!(last.end_reason, Some(EndReason::Stuck));
    assert_eq!(last.end_reason.unwrap().to_string(), "stuck");
    assert!(last.is_terminal);
    assert_eq!(last.discount, 0.0);
    assert_eq!(env.step(&[0.0, 0.0]), Err(EnvError::EpisodeOver));
    assert!(env.reset(1).is_ok() && env.step(&[0.0, 0.0]).is_ok());
}

#[test]
fn the_sum_of_rewards_is_their_mean_times_the_frames() {
    let config = |repeat_reward| EnvConfig {
        repeat_reward,
        ..EnvConfig::default()
    };
    let mut mean = make(&config(RepeatReward::Mean)).unwrap();
    let mut sum = make(&config(RepeatReward::Sum)).unwrap();
    mean.reset(9).unwrap();
    sum.reset(9).unwrap();
    for _ in 0..20 {
        let (a, b) = (
            mean.step(&[0.1, 0.7]).unwrap(),
            sum.step(&[0.1, 0.7]).unwrap(),
        );
        assert!((4.0 * a.reward - b.reward).abs() < 1e-5);
    }
}

#[test]
fn steering_alone_costs_its_amount() {
    let mut env = env("highway/day");
    env.reset(4).unwrap();
    // At rest only the steering term is left; actions beyond the range are clamped first.
    assert!((env.step(&[-0.25, 0.0]).unwrap().reward + 0.25).abs() < 1e-6);
    assert!((env.step(&[7.0, 0.0]).unwrap().reward + 1.0).abs() < 1e-6);
}

#[test]
fn bad_actions_are_refused_and_change_nothing() {
    let mut tried = env("highway/day");
    assert_eq!(tried.step(&[0.0, 0.0]), Err(EnvError::NotReset));
    tried.reset(6).unwrap();
    assert_eq!(
        tried.step(&[0.0]),
        Err(EnvError::ActionDim {
            expected: 2,
            actual: 1
        })
    );
    assert_eq!(
        tried.step(&[0.0; 3]),
        Err(EnvError::ActionDim {
            expected: 2,
            actual: 3
        })
    );
    for bad in [f32::NAN, f32::INFINITY] {
        let refused = tried.step(&[0.0, bad]);
        assert!(matches!(
            refused,
            Err(EnvError::ActionNotFinite { index: 1, .. })
        ));
    }
    let mut untouched = env("highway/day");
    untouched.reset(6).unwrap();
    assert_eq!(tried.step(&[0.2, 1.0]), untouched.step(&[0.2, 1.0]));
}

#[test]
fn unknown_ids_are_told_the_nearest_ones() {
    let config = EnvConfig {
        id: "highway/dusk".into(),
        ..EnvConfig::default()
    };
    let message = make(&config).err().unwrap().to_string();
    assert!(message.contains("highway/dusk"));
    for near in ["highway/day", "isodream env list"] {
        assert!(message.contains(near), "{message}");
    }
    assert!(spec(&config).is_err());
}

#[test]
fn impossible_configs_are_refused() {
    let refused = |change: fn(&mut EnvConfig)| {
        let mut config = EnvConfig::default();
        change(&mut config);
        matches!(make(&config).err(), Some(EnvError::InvalidConfig { .. }))
    };
    assert!(refused(|config| config.image_size = 0));
    assert!(refused(|config| config.action_repeat = 0));
    assert!(refused(|config| config.time_limit = 0));
    assert!(refused(|config| config.vehicles = 10_000));
}

#[test]
fn the_spec_is_that_of_the_made_environment() {
    let config = EnvConfig {
        image_size: 33,
        ..EnvConfig::default()
    };
    let mut made = make(&config).unwrap();
    assert_eq!(made.spec(), &spec(&config).unwrap());
    assert_eq!(made.segmentation(), None);
    assert_eq!(made.privileged(), None);
    assert_eq!(
        made.reset(0).unwrap().image.len(),
        made.spec().image.bytes()
    );
    assert_eq!(made.segmentation().unwrap().len(), 33 * 33);
}

/// Returns on the road of `id`, which differ by what the driver looks at.
fn ranking(id: &str) -> [f64; 4] {
    const EPISODES: u64 = 16;
    let mut env = make_without_pictures(&EnvConfig {
        id: id.into(),
        ..EnvConfig::default()
    })
    .unwrap();
    let drivers = [
        ScriptedDriver::Blind,
        ScriptedDriver::KeepLane,
        ScriptedDriver::Reacting,
        ScriptedDriver::Foreseeing,
    ];
    drivers.map(|scripted| {
        score(env.as_mut(), EPISODES, &|seed| scripted.driver(seed))
            .unwrap()
            .mean()
    })
}

/// With fewer episodes than `isodream env drivers` has, so that the bounds are wider.
#[test]
fn looking_pays_and_looking_ahead_pays_more() {
    for id in ["highway/day", "highway/straight/day"] {
        let [blind, keep_lane, reacting, foreseeing] = ranking(id);
        println!("{id}: {blind:.1} {keep_lane:.1} {reacting:.1} {foreseeing:.1}");
        assert!(blind < 0.55 * keep_lane, "{id}");
        assert!(keep_lane < 0.7 * reacting, "{id}");
        assert!(reacting < 0.97 * foreseeing, "{id}");
    }
}

#[test]
fn pushing_harder_never_pays() {
    let mut env = make_without_pictures(&EnvConfig::default()).unwrap();
    let mut earned = |pedal| {
        let blind = |_| Box::new(BlindDriver::new(pedal)) as Box<dyn Driver>;
        score(env.as_mut(), 40, &blind).unwrap().mean()
    };
    let [none, best, pushing, flooring] = [0.0, BEST_BLIND_PEDAL, 0.3, 1.0].map(&mut earned);
    println!("{none:.1} {best:.1} {pushing:.1} {flooring:.1}");
    assert!(none < 1.0 && best > 25.0);
    assert!(pushing < best - 5.0 && flooring < pushing);
}

/// With a shoulder as wide as a car, nobody who drives there would need to look.
#[test]
fn the_shoulder_passes_nobody() {
    let mut env = make_without_pictures(&EnvConfig::default()).unwrap();
    let mut earned =
        |driver: &dyn Fn(u64) -> Box<dyn Driver>| score(env.as_mut(), 16, driver).unwrap().mean();
    let lane = earned(&|_| Box::new(BlindDriver::new(BEST_BLIND_PEDAL)));
    for pedal in [0.07, 0.15, 0.3, 0.6, 1.0] {
        let shoulder = earned(&|_| Box::new(BlindDriver::on_the_shoulder(pedal)));
        println!("{pedal}: {shoulder:.1}, in the lane {lane:.1} at best");
        assert!(shoulder < lane);
    }
}

#[test]
fn a_simulator_has_the_future_of_its_environment() {
    let mut env = env("highway/day");
    let mut driver = ScriptedDriver::Wander.driver(3);
    env.reset(3).unwrap();
    for _ in 0..40 {
        let action = driver.act(env.as_ref()).unwrap();
        env.step(&action).unwrap();
    }
    let mut future = env.simulator().unwrap();
    let untouched = future.fork();
    for _ in 0..80 {
        let action = driver.act(env.as_ref()).unwrap();
        let row = env.step(&action).unwrap();
        let outlook = future.step(&action);
        assert_eq!(
            (outlook.reward as f32, outlook.is_last),
            (row.reward, row.is_last)
        );
        assert_eq!(Some(future.privileged()), env.privileged());
        if row.is_last {
            break;
        }
    }
    assert_ne!(untouched.privileged(), future.privileged());
}

#[test]
fn the_wandering_driver_holds_its_actions_and_is_wild_at_times() {
    let mut env = env("highway/day");
    let mut driver = ScriptedDriver::Wander.driver(1);
    let (mut steps, mut held, mut jumps, mut steers) = (0, 0, 0, 0);
    for seed in 0..8 {
        let mut row = env.reset(seed).unwrap();
        let mut before = f32::NAN;
        while !row.is_last {
            let action = driver.act(env.as_ref()).unwrap();
            assert!(action.iter().all(|value| value.abs() <= 1.0));
            let change = (action[1] - before).abs();
            steps += 1;
            held += u32::from(change < 0.15);
            jumps += u32::from(change > 0.5);
            steers += u32::from(action[0].abs() > 0.3);
            before = action[1];
            row = env.step(&action).unwrap();
        }
    }
    println!("{steps} steps: {held} held, {jumps} jumps, {steers} with much steering");
    assert!(steps > 300 && 10 * held > 5 * steps);
    // At times it is as wild as uniform actions: what hard steering costs has to be seen.
    assert!(50 * jumps > steps && 50 * steers > steps);
}

#[test]
fn every_density_can_be_driven_and_an_empty_road_is_fastest() {
    let returns = [0, 30, 60].map(|vehicles| {
        let mut env = make(&EnvConfig {
            vehicles,
            ..EnvConfig::default()
        })
        .unwrap();
        env.reset(2).unwrap();
        let cars = env.privileged().unwrap().vehicles;
        assert_eq!(cars.len(), vehicles as usize);
        let near = cars.iter().filter(|car| car.ahead_m.abs() < 140.0).count();
        assert_eq!(near, cars.len());
        let (transitions, metrics) = episode(env.as_mut(), ScriptedDriver::Reacting, 2);
        assert_eq!(transitions.len(), 251, "{vehicles} cars");
        assert_eq!(metric(&metrics, "collisions"), 0.0, "{vehicles} cars");
        total(&transitions)
    });
    println!("{returns:.1?}");
    assert!(returns[0] > returns[1] + 20.0 && returns[0] > returns[2] + 30.0);
    assert!(returns[2] > 20.0, "traffic jams: {returns:?}");
}

#[test]
fn nobody_is_stuck_at_the_start_for_waiting_in_a_queue() {
    for vehicles in [45, 60] {
        let mut env = make(&EnvConfig {
            vehicles,
            ..EnvConfig::default()
        })
        .unwrap();
        for seed in 0..20 {
            let mut driver = ScriptedDriver::KeepLane.driver(seed);
            env.reset(seed).unwrap();
            for step in 0..30 {
                let action = driver.act(env.as_ref()).unwrap();
                let end = env.step(&action).unwrap().end_reason;
                assert_eq!(end, None, "{vehicles} cars, seed {seed}, step {step}");
            }
        }
    }
}

#[test]
fn overtaking_causes_interactions_and_keeping_the_lane_does_not() {
    let mut env = env("highway/day");
    let mut count = |driver| -> f64 {
        (0..5)
            .map(|seed| {
                let (transitions, metrics) = episode(env.as_mut(), driver, seed);
                let flagged = transitions.iter().filter(|t| t.interaction).count() as f64;
                let counted = metric(&metrics, "interactions");
                assert!(counted <= flagged && (counted > 0.0) == (flagged > 0.0));
                counted
            })
            .sum()
    };
    assert!(count(ScriptedDriver::Reacting) >= 3.0);
    assert_eq!(count(ScriptedDriver::KeepLane), 0.0);
}

#[test]
fn a_long_random_drive_meets_every_class() {
    let mut env = env("highway/day");
    let mut seen = [0_usize; 3];
    for seed in 0..3 {
        env.reset(seed).unwrap();
        for class in env.segmentation().unwrap() {
            seen[usize::from(class)] += 1;
        }
    }
    for class in [class::BACKGROUND, class::ROAD, class::VEHICLE] {
        assert!(seen[usize::from(class)] > 100, "class {class}: {seen:?}");
    }
}

#[test]
fn drivers_are_found_by_name() {
    for driver in ScriptedDriver::ALL {
        assert_eq!(driver.to_string().parse(), Ok(driver));
    }
    let message = "fast".parse::<ScriptedDriver>().unwrap_err().to_string();
    assert!(message.contains("fast") && message.contains("keep_lane"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Holding extreme controls for long stretches reaches walls, spins and pile-ups.
    #[test]
    fn no_way_of_driving_breaks_the_world(
        seed in 0_u64..1_000,
        controls in prop::collection::vec((-1.0_f32..=1.0, -0.3_f32..=1.0, 1_usize..40), 12),
    ) {
        let mut env = env("highway/day");
        env.reset(seed).unwrap();
        'episode: for (steer, pedal, steps) in controls {
            for _ in 0..steps {
                let transition = env.step(&[steer, pedal]).unwrap();
                let view = env.privileged().unwrap();
                prop_assert!(transition.reward.is_finite());
                prop_assert!(transition.reward > -10.0 && transition.reward < 1.5);
                prop_assert!(view.speed_m_s.abs() < 35.0, "speed {}", view.speed_m_s);
                prop_assert!(view.d_m.abs() < 9.0, "d {}", view.d_m);
                prop_assert!(transition.end_reason != Some(EndReason::OffRoad));
                prop_assert!(view.vehicles.iter().all(|car| car.d_m.abs() < 8.5));
                if transition.is_last {
                    break 'episode;
                }
            }
        }
    }
}
