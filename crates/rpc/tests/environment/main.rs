//! Environments over real sockets: what arrives is what was sent, and what goes wrong is said.

#![allow(clippy::unwrap_used)]

mod odd;
mod world;

use std::time::{Duration, Instant};

use isodream_core::config::EnvConfig;
use isodream_envs::{EnvError, Environment, RemoteFault, VectorEnvironment};
use isodream_rpc::{RemoteEnvironment, RemoteOptions, environment_spec, open_environments};

use crate::world::{Act, PATIENT, SHORT, Served, TWO, World, options};

/// Resets and makes two of the three steps that [`Act`] waits for.
fn two_steps(env: &mut dyn Environment) {
    env.reset(1).unwrap();
    for _ in 0..2 {
        env.step(&[0.0; 2]).unwrap();
    }
}

#[test]
fn a_remote_environment_is_its_original() {
    let config = EnvConfig {
        time_limit: 4,
        vehicles: 5,
        ..EnvConfig::default()
    };
    let mut local = isodream_envs::make(&config).unwrap();
    let served = Served::environments(vec![isodream_envs::make(&config).unwrap()]);
    let with_classes = RemoteOptions {
        segmentation: true,
        ..options(PATIENT)
    };
    let mut remote = RemoteEnvironment::connect(
        &isodream_rpc::Dialer::default(),
        &served.address,
        with_classes,
    )
    .unwrap();
    assert_eq!(remote.spec(), local.spec());
    assert_eq!(remote.step(&[0.0, 1.0]), Err(EnvError::NotReset));
    for seed in [3, 4] {
        assert_eq!(remote.reset(seed), local.reset(seed));
        for step in 0..4 {
            let action = [0.1 * step as f32, 1.7];
            assert_eq!(remote.step(&action), local.step(&action));
            assert_eq!(remote.segmentation(), local.segmentation());
            assert_eq!(remote.metrics(), local.metrics());
        }
        assert_eq!(remote.step(&[0.0, 0.0]), Err(EnvError::EpisodeOver));
    }
    let wrong = remote.step(&[0.0; 3]);
    assert_eq!(
        wrong,
        Err(EnvError::ActionDim {
            expected: 2,
            actual: 3
        })
    );
}

#[test]
fn a_batch_of_remote_environments_runs_over_one_connection() {
    let config = EnvConfig {
        time_limit: 3,
        vehicles: 3,
        ..EnvConfig::default()
    };
    let make = || isodream_envs::make(&config).unwrap();
    let served = Served::environments((0..3).map(|_| make()).collect());
    let remote = RemoteEnvironment::connect_many(
        &isodream_rpc::Dialer::default(),
        &served.address,
        3,
        options(PATIENT),
    )
    .unwrap();
    let boxed = remote
        .into_iter()
        .map(|env| Box::new(env) as Box<dyn Environment>);
    let mut remote = VectorEnvironment::new(boxed.collect(), 5, TWO).unwrap();
    let mut local = VectorEnvironment::new((0..3).map(|_| make()).collect(), 5, TWO).unwrap();
    assert_eq!(remote.len(), 3);
    assert_eq!(remote.reset(), local.reset());
    for step in 0..7 {
        let actions = [0.0, 1.0, 0.1 * step as f32, 0.5, -0.2, 0.9];
        assert_eq!(remote.step(&actions), local.step(&actions), "step {step}");
    }
}

#[test]
fn rows_that_make_no_sense_are_refused_and_a_reset_goes_on() {
    for (act, words) in [
        (Act::NanReward, "the reward is NaN"),
        (Act::ShortImage, "the image has 7 bytes, 2x3x3 need 18"),
    ] {
        let served = Served::environments(vec![World::boxed(act)]);
        let mut env = served.connect(PATIENT);
        two_steps(&mut env);
        let error = env.step(&[0.0; 2]).unwrap_err();
        assert!(
            matches!(error, EnvError::InvalidTransition { step: 3, .. }),
            "{error}"
        );
        assert!(error.to_string().contains(words), "{error}");
        assert_eq!(env.step(&[0.0; 2]), Err(EnvError::NotReset));
        two_steps(&mut env);
    }
}

#[test]
fn errors_and_panics_over_there_are_reported_and_a_reset_goes_on() {
    for (act, words) in [(Act::Fail, "episode is over"), (Act::Panic, "panicked")] {
        let served = Served::environments(vec![World::boxed(act)]);
        let mut env = served.connect(PATIENT);
        two_steps(&mut env);
        let error = env.step(&[0.0; 2]).unwrap_err();
        let EnvError::Remote {
            address,
            fault: RemoteFault::Failed(reason),
        } = &error
        else {
            panic!("{error}");
        };
        assert_eq!(*address, served.address);
        assert!(reason.contains(words), "{reason}");
        two_steps(&mut env);
    }
}

#[test]
fn a_hanging_environment_meets_the_deadline_and_a_reset_connects_again() {
    let served = Served::environments(vec![World::boxed(Act::Hang(2 * SHORT))]);
    let mut env = served.connect(SHORT);
    two_steps(&mut env);
    let error = env.step(&[0.0; 2]).unwrap_err();
    let deadline = |fault: &RemoteFault| *fault == RemoteFault::Deadline(SHORT);
    assert!(
        matches!(&error, EnvError::Remote { fault, .. } if deadline(fault)),
        "{error}"
    );
    let connected = (0..20).any(|_| env.reset(1).is_ok());
    assert!(
        connected,
        "the environment must have woken up, no reset reaches it"
    );
    env.step(&[0.0; 2]).unwrap();
}

#[test]
fn a_killed_server_is_lost_at_once_and_found_again_after_its_restart() {
    let served = Served::environments(vec![World::boxed(Act::Nothing)]);
    let mut env = served.connect(PATIENT);
    two_steps(&mut env);
    let address = served.kill();
    let before = Instant::now();
    let error = env.step(&[0.0; 2]).unwrap_err();
    assert!(before.elapsed() < PATIENT / 2, "{:?}", before.elapsed());
    assert!(
        matches!(
            &error,
            EnvError::Remote {
                fault: RemoteFault::Lost(_),
                ..
            }
        ),
        "{error}"
    );
    assert!(error.to_string().contains(&address), "{error}");

    let _served = Served::environments_at(&address, vec![World::boxed(Act::Nothing)]);
    two_steps(&mut env);
}

#[test]
fn a_server_that_changed_its_spec_is_refused() {
    let served = Served::environments(vec![World::boxed(Act::Nothing)]);
    let mut env = served.connect(PATIENT);
    env.reset(1).unwrap();
    let address = served.kill();
    assert!(env.step(&[0.0; 2]).is_err());
    let other = isodream_envs::make(&EnvConfig::default()).unwrap();
    let _served = Served::environments_at(&address, vec![other]);
    let error = env.reset(1).unwrap_err();
    assert!(
        error.to_string().contains("now offers highway/day"),
        "{error}"
    );
}

#[test]
fn nobody_there_and_impossible_addresses_are_named() {
    let free = Served::environments(vec![World::boxed(Act::Nothing)]).kill();
    for (address, words) in [(free.as_str(), "connection lost"), ("nowhere", "host:port")] {
        let error =
            RemoteEnvironment::connect(&isodream_rpc::Dialer::default(), address, options(PATIENT))
                .err()
                .unwrap();
        assert!(error.to_string().contains(words), "{error}");
        assert!(error.to_string().contains(address), "{error}");
    }
}

#[test]
fn clients_share_a_server_until_nothing_is_free() {
    let worlds = (0..3).map(|_| World::boxed(Act::Nothing)).collect();
    let served = Served::environments(worlds);
    let connect = |count| {
        RemoteEnvironment::connect_many(
            &isodream_rpc::Dialer::default(),
            &served.address,
            count,
            options(PATIENT),
        )
    };
    let mut two = connect(2).unwrap();
    let mut one = served.connect(PATIENT);
    two_steps(&mut two[0]);
    two_steps(&mut one);
    two_steps(&mut two[1]);
    assert_eq!(
        one.step(&[1.0; 2]).unwrap().image,
        [3; 18],
        "its own third step"
    );
    let error = connect(1).err().unwrap().to_string();
    assert!(error.contains("0 of 3 are free"), "{error}");
    let offered = RemoteEnvironment::offered(
        &isodream_rpc::Dialer::default(),
        &served.address,
        options(PATIENT),
    )
    .unwrap();
    assert_eq!(&offered, one.spec(), "a spec needs no environment");
    drop(two);
    let found = (0..200).any(|_| {
        std::thread::sleep(Duration::from_millis(10));
        connect(2).is_ok()
    });
    assert!(found, "the first client's environments are never free");
}

#[test]
fn a_configuration_opens_environments_elsewhere_as_it_asks_for_them() {
    let config = EnvConfig {
        vehicles: 3,
        time_limit: 20,
        ..EnvConfig::default()
    };
    let make = |_| isodream_envs::make(&config).unwrap();
    let served = Served::environments((0..2).map(make).collect());
    let wanted = EnvConfig {
        id: format!("grpc://{}", served.address),
        image_size: 32,
        action_repeat: 8,
        time_limit: 6,
        ..config.clone()
    };
    let spec = environment_spec(&isodream_rpc::Dialer::default(), &wanted, PATIENT).unwrap();
    assert_eq!((spec.id.as_str(), spec.action_repeat), ("highway/day", 8));
    let mut opened = open_environments(&isodream_rpc::Dialer::default(), &wanted, 2).unwrap();
    for env in &mut opened {
        assert_eq!(env.spec(), &spec);
        assert_eq!(env.reset(4).unwrap().image.len(), 32 * 32 * 3);
        let ends: Vec<bool> = (0..6)
            .map(|_| env.step(&[0.0; 2]).unwrap().is_last)
            .collect();
        assert_eq!(ends, [false, false, false, false, false, true]);
    }
    let odd = EnvConfig {
        action_repeat: 6,
        ..wanted
    };
    let error = environment_spec(&isodream_rpc::Dialer::default(), &odd, PATIENT)
        .unwrap_err()
        .to_string();
    assert!(error.contains("repeats 4 times"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_works_on_another_runtimes_threads() {
    // Blocking on a second runtime would panic there.
    let served = Served::environments(vec![World::boxed(Act::Nothing)]);
    let mut env = served.connect(PATIENT);
    env.reset(1).unwrap();
    assert_eq!(env.step(&[0.25, 0.5]).unwrap().reward, 0.75);
}
