//! DeepMind Control: the same as dm_control, which is installed into `.native/dm_control` for it, and its errors.

#![cfg(feature = "mujoco")]

use std::path::Path;
use std::{fs, thread};

use isodream_envs::EnvError;
use isodream_envs::dmc::parity::{Parity, Peer, Plan};
use isodream_envs::dmc::{ControlError, ControlTask, ids};

/// The tasks of the paper come first.
const MAIN: [&str; 4] = ["finger_spin", "hopper_stand", "walker_walk", "cheetah_run"];
/// Random actions never get there.
const NEVER_EARNED: &str = "acrobot_swingup_sparse";

#[test]
fn states_and_rewards_are_those_of_dm_control() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../.native/dm_control");
    let peer = Peer::install(&folder).unwrap();
    let all: Vec<&str> = ids().collect();
    assert_eq!(all[..4], MAIN);
    // Dealt out, so that both halves have their share of slow models.
    let halves = [0, 1].map(|first| {
        all.iter()
            .skip(first)
            .step_by(2)
            .copied()
            .collect::<Vec<_>>()
    });
    let results: Vec<Parity> = thread::scope(|scope| {
        let running = halves.each_ref().map(|half| {
            let peer = &peer;
            scope.spawn(move || peer.compare(half, Plan::FULL).unwrap())
        });
        running
            .into_iter()
            .flat_map(|thread| thread.join().unwrap())
            .collect()
    });
    assert_eq!(results.len(), all.len());
    for result in results {
        let main = MAIN.contains(&result.id);
        let (state, reward) = if main { (0.0, 1e-15) } else { (1e-9, 1e-9) };
        assert!(result.max_abs_state_diff <= state, "{result:?}");
        assert!(result.max_abs_reward_diff <= reward, "{result:?}");
        let earned = result.best_reward > 0.0;
        assert_eq!(earned, result.id != NEVER_EARNED, "{result:?}");
    }
}

#[test]
fn a_seed_repeats_itself_whatever_came_before() {
    let mut task = ControlTask::load("reacher_easy").unwrap();
    let mut play = |seed| {
        task.reset(seed).unwrap();
        let rewards: Vec<f64> = (0..50).map(|_| task.step(&[0.3, -0.7]).unwrap()).collect();
        (
            rewards,
            task.qpos().to_vec(),
            task.model().geom_pos().to_vec(),
        )
    };
    let first = play(3);
    let other = play(4);
    assert_ne!(first.1, other.1);
    assert_ne!(first.2, other.2, "the target moves");
    assert_eq!(first, play(3));
}

#[test]
fn the_next_episode_is_another_one() {
    let mut task = ControlTask::load("walker_walk").unwrap();
    task.reset(5).unwrap();
    let first = task.qpos().to_vec();
    task.reset_next().unwrap();
    assert_ne!(task.qpos(), first);
}

#[test]
fn actions_are_checked_and_clamped() {
    let mut task = ControlTask::load("finger_spin").unwrap();
    assert_eq!(task.step(&[0.0, 0.0]), Err(EnvError::NotReset));
    task.reset(0).unwrap();
    let wrong = EnvError::ActionDim {
        expected: 2,
        actual: 1,
    };
    assert_eq!(task.step(&[0.0]), Err(wrong));
    let nan = task.step(&[0.0, f64::NAN]);
    assert!(matches!(
        nan,
        Err(EnvError::ActionNotFinite { index: 1, .. })
    ));

    let mut play = |action: [f64; 2]| {
        task.reset(0).unwrap();
        task.step(&action).unwrap();
        task.qvel().to_vec()
    };
    assert_eq!(play([7.0, -9.0]), play([1.0, -1.0]));
    assert_ne!(play([0.5, -1.0]), play([1.0, -1.0]));
}

#[test]
fn a_simulation_that_explodes_says_so_and_starts_anew() {
    let mut task = ControlTask::load("cartpole_swingup").unwrap();
    task.reset(0).unwrap();
    task.data_mut().qvel_mut()[0] = f64::NAN;
    let error = task.step(&[0.0]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "simulation became invalid (bad qvel), reset the environment"
    );
    assert_eq!(task.step(&[0.0]), Err(EnvError::EpisodeOver));
    task.reset(0).unwrap();
    assert!(task.step(&[0.0]).unwrap().is_finite());
}

#[test]
fn missing_and_broken_models_are_named_with_the_cure() {
    let folder = std::env::temp_dir().join(format!("isodream-suite-{}", std::process::id()));
    fs::create_dir_all(&folder).unwrap();
    let load = || ControlTask::load_from("pendulum_swingup", &folder).unwrap_err();

    let error = load();
    assert!(matches!(
        error,
        EnvError::Control(ControlError::ModelMissing { .. })
    ));
    let text = error.to_string();
    for part in [
        folder.to_str().unwrap(),
        "pendulum.xml",
        "cargo xtask setup",
        "ISODREAM_SUITE_DIR",
    ] {
        assert!(text.contains(part), "{text}");
    }

    let model = folder.join("pendulum.xml");
    fs::write(&model, "<mujoco><worldbody>").unwrap();
    let text = load().to_string();
    assert!(text.contains("XML") && text.contains("--verify"), "{text}");
    fs::write(&model, "<mujoco/>").unwrap();
    let text = load().to_string();
    assert!(text.contains("no joint \"hinge\""), "{text}");
    fs::remove_dir_all(folder).unwrap();

    let unknown = ControlTask::load("walker_fly").unwrap_err().to_string();
    assert!(unknown.contains("walker_fly") && unknown.contains("walker_walk"));
}

#[test]
fn mujoco_is_silent() {
    // Its default is to append to this file and to write to the terminal: the cheetah's model makes it warn.
    let log = Path::new("MUJOCO_LOG.TXT");
    let size = || fs::metadata(log).map_or(0, |metadata| metadata.len());
    let before = size();
    ControlTask::load("cheetah_run").unwrap();
    assert_eq!(size(), before);
}

#[test]
fn tasks_can_be_sent_to_threads() {
    let mut task = ControlTask::load("point_mass_easy").unwrap();
    let reward = thread::spawn(move || {
        task.reset(0).unwrap();
        task.step(&[0.0, 0.0]).unwrap()
    });
    assert!((0.0..=1.0).contains(&reward.join().unwrap()));
}
