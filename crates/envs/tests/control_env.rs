//! DeepMind Control as agents see it: pictures, rewards of repeated actions, ends, and videos in the background.

#![cfg(feature = "mujoco")]

use std::fs;

use isodream_core::config::{BackgroundOrder, EnvConfig, RepeatReward};
use isodream_envs::dmc::ControlTask;
use isodream_envs::{EndReason, EnvError, class, ids, make, spec};

fn config(id: &str) -> EnvConfig {
    EnvConfig {
        id: id.into(),
        action_repeat: 2,
        time_limit: 3,
        repeat_reward: RepeatReward::Sum,
        ..EnvConfig::default()
    }
}

#[test]
fn a_step_is_two_control_steps_with_the_sum_of_their_rewards() {
    let mut env = make(&config("dmc/walker_stand")).unwrap();
    assert_eq!(env.spec().action_dim, 6);
    let mut task = ControlTask::load("walker_stand").unwrap();
    let action = [0.3_f32, -0.2, 0.1, 0.9, -1.0, 0.5];
    let exact = action.map(f64::from);
    assert_eq!(env.step(&action), Err(EnvError::NotReset));
    let first = env.reset(11).unwrap();
    task.reset(11).unwrap();
    assert_eq!((first.reward, first.image.len()), (0.0, 64 * 64 * 3));
    for step in 1..=3 {
        let next = env.step(&action).unwrap();
        let sum = task.step(&exact).unwrap() + task.step(&exact).unwrap();
        assert!(sum > 0.0);
        assert_eq!(next.reward, sum as f32);
        assert_eq!(next.is_last, step == 3);
        assert_eq!((next.is_terminal, next.discount), (false, 1.0));
        assert_eq!(next.end_reason, (step == 3).then_some(EndReason::TimeLimit));
        assert_ne!(next.image, first.image);
    }
    assert_eq!(env.step(&action), Err(EnvError::EpisodeOver));
}

#[test]
fn a_refused_action_does_not_end_the_episode() {
    let mut env = make(&config("dmc/finger_spin")).unwrap();
    env.reset(0).unwrap();
    let wrong = EnvError::ActionDim {
        expected: 2,
        actual: 1,
    };
    assert_eq!(env.step(&[0.0]), Err(wrong));
    assert!(env.step(&[0.0, f32::NAN]).is_err());
    assert!(env.step(&[0.0, 0.0]).is_ok());
}

#[test]
fn videos_take_the_place_of_sky_and_floor() {
    let seen = |id: &str| {
        let mut env = make(&config(id)).unwrap();
        let image = env.reset(5).unwrap().image;
        (image, env.segmentation().unwrap())
    };
    let (plain, classes) = seen("dmc/walker_walk");
    let (easy, easy_classes) = seen("dmc/walker_walk/video_easy");
    let (hard, hard_classes) = seen("dmc/walker_walk/video_hard");
    let count = |classes: &[u8], wanted: u8| classes.iter().filter(|&&c| c == wanted).count();
    assert!(count(&classes, class::AGENT) > 100);
    assert!(count(&classes, class::ROAD) > 500);
    assert!(count(&classes, class::BACKGROUND) > 500);
    assert!(count(&easy_classes, class::ROAD) > 500, "the floor stays");
    assert_eq!(count(&hard_classes, class::VEHICLE), 0);
    assert!(
        count(&hard_classes, class::ROAD) < count(&easy_classes, class::ROAD) / 4,
        "the floor goes"
    );
    let differing = |a: &[u8], b: &[u8], wanted: u8| {
        let pixels = a.chunks(3).zip(b.chunks(3)).zip(&classes);
        let of_class: Vec<_> = pixels.filter(|(_, class)| **class == wanted).collect();
        let differ = of_class.iter().filter(|((a, b), _)| a != b).count();
        differ as f64 / of_class.len() as f64
    };
    assert!(differing(&plain, &easy, class::BACKGROUND) > 0.95);
    assert!(differing(&plain, &hard, class::ROAD) > 0.8);
    let body = differing(&plain, &hard, class::AGENT);
    assert!(body < 0.3, "the body stays, but for its edges: {body}");
}

#[test]
fn the_seed_or_the_order_chooses_the_video() {
    let id = "dmc/pendulum_swingup/video_easy";
    let first_picture = |seed| make(&config(id)).unwrap().reset(seed).unwrap().image;
    assert_eq!(first_picture(1), first_picture(1));
    assert_ne!(first_picture(1), first_picture(2));
    let mut env = make(&EnvConfig {
        background_order: BackgroundOrder::Sequential,
        ..config(id)
    })
    .unwrap();
    let pictures: Vec<_> = (0..2).map(|_| env.reset(7).unwrap().image).collect();
    assert_ne!(pictures[0], pictures[1], "the next video each time");
}

#[test]
fn the_video_goes_on_with_every_step() {
    let mut env = make(&config("dmc/ball_in_cup_catch/video_hard")).unwrap();
    env.reset(3).unwrap();
    let pictures: Vec<_> = (0..3)
        .map(|_| env.step(&[0.0, 0.0]).unwrap().image)
        .collect();
    assert_ne!(pictures[0], pictures[1]);
    assert_ne!(pictures[1], pictures[2]);
}

#[test]
fn a_folder_without_videos_is_named() {
    let folder = std::env::temp_dir().join(format!("isodream-no-videos-{}", std::process::id()));
    fs::create_dir_all(&folder).unwrap();
    let error = make(&EnvConfig {
        backgrounds: folder.display().to_string(),
        ..config("dmc/walker_walk/video_easy")
    })
    .err()
    .unwrap();
    assert!(
        error.to_string().contains(folder.to_str().unwrap()),
        "{error}"
    );
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn every_task_has_its_ids_and_the_actions_of_its_model() {
    let listed: Vec<&str> = ids()
        .iter()
        .copied()
        .filter(|id| id.starts_with("dmc/"))
        .collect();
    assert_eq!(listed.len(), 3 * isodream_envs::dmc::ids().count());
    for task in isodream_envs::dmc::ids() {
        let loaded = ControlTask::load(task).unwrap();
        let spec = spec(&config(&format!("dmc/{task}"))).unwrap();
        assert_eq!(spec.action_dim, loaded.action_dim());
    }
    let error = spec(&config("dmc/walker_wlak")).unwrap_err().to_string();
    assert!(error.contains("dmc/walker_walk"), "{error}");
}
