//! Pictures of DeepMind Control against those of dm_control's own renderer.
//!
//! `pixels/TASK.png` is `physics.render(64, 64, camera_id=0)` of dm_control 1.0.50 with MuJoCo 3.17.0 on OSMesa, after
//! 20 steps from seed 1 whose actions are those of [`swing`]; `TASK_hard.png` is the same with the textures "skybox"
//! and "grid" in (.2, .8, .2), as in DMC-GB's `video_hard`.

#![cfg(feature = "mujoco")]

use std::path::Path;

use isodream_envs::EnvError;
use isodream_envs::dmc::{ControlTask, Recolour, SceneRenderer, ids};
use isodream_envs::raycast::Class;

const SIDE: usize = 64;
const TASKS: [&str; 4] = ["finger_spin", "hopper_stand", "walker_walk", "cheetah_run"];

/// The task after twenty steps of swinging.
fn swing(id: &str) -> Result<ControlTask, EnvError> {
    let mut task = ControlTask::load(id)?;
    task.reset(1)?;
    for step in 0..20 {
        let sign = |joint: usize| {
            if (step / 5 + joint).is_multiple_of(2) {
                0.8
            } else {
                -0.8
            }
        };
        let action: Vec<f64> = (0..task.action_dim()).map(sign).collect();
        task.step(&action)?;
    }
    Ok(task)
}

fn reference(name: &str) -> image::ImageResult<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/pixels");
    let image = image::open(folder.join(format!("{name}.png")))?;
    Ok(image.into_rgb8().into_raw())
}

/// Mean absolute difference of two pictures, and the share of pixels that differ by more than 16.
fn difference(a: &[u8], b: &[u8]) -> (f64, f64) {
    assert_eq!(a.len(), b.len());
    let apart: Vec<u32> = a
        .iter()
        .zip(b)
        .map(|(a, b)| u32::from(a.abs_diff(*b)))
        .collect();
    let mean = f64::from(apart.iter().sum::<u32>()) / apart.len() as f64;
    let pixels = apart.chunks(3);
    let off = pixels
        .filter(|pixel| pixel.iter().any(|&value| value > 16))
        .count();
    (mean, off as f64 / (apart.len() / 3) as f64)
}

/// Whether DMC-GB would put its video in place of the pixel.
fn is_key(pixel: &[u8]) -> bool {
    let [r, g, b] = [pixel[0], pixel[1], pixel[2]].map(f64::from);
    let (high, low) = (r.max(g).max(b), r.min(g).min(b));
    let range = high - low;
    if range == 0.0 || high == r {
        return false;
    }
    let hue = if high == g {
        60.0 * ((b - r) / range + 2.0)
    } else {
        60.0 * ((r - g) / range + 4.0)
    };
    (100.0..=185.0).contains(&hue) && range / high * 255.0 >= 80.0 && high >= 70.0
}

#[test]
fn pictures_are_those_of_dm_control() {
    for id in TASKS {
        let mut task = swing(id).unwrap();
        let mut renderer = SceneRenderer::new(&task, (SIDE, SIDE), Recolour::None).unwrap();
        let (mean, off) = difference(&renderer.render(&mut task), &reference(id).unwrap());
        assert!(mean < 0.75, "{id}: {mean}");
        assert!(off < 0.015, "{id}: {off}");
    }
}

#[test]
fn green_pictures_have_the_same_mask() {
    for id in TASKS {
        let mut task = swing(id).unwrap();
        let mut renderer =
            SceneRenderer::new(&task, (SIDE, SIDE), Recolour::SkyboxAndGrid).unwrap();
        let picture = renderer.render(&mut task);
        let expected = reference(&format!("{id}_hard")).unwrap();
        let (mean, _) = difference(&picture, &expected);
        assert!(mean < 0.75, "{id}: {mean}");
        let pairs = picture.chunks(3).zip(expected.chunks(3));
        let same = pairs.filter(|(a, b)| is_key(a) == is_key(b)).count();
        let agreement = same as f64 / (SIDE * SIDE) as f64;
        assert!(agreement >= 0.999, "{id}: {agreement}");
        let floor = renderer.classes().iter().zip(picture.chunks(3));
        let mut floor = floor.filter(|(class, _)| **class == Class::Floor);
        assert!(
            floor.any(|(_, pixel)| is_key(pixel)),
            "{id}: the floor is green too"
        );
    }
}

#[test]
fn the_sky_alone_is_green_for_easy_videos() {
    let mut task = swing("walker_walk").unwrap();
    let mut plain = SceneRenderer::new(&task, (SIDE, SIDE), Recolour::None).unwrap();
    let mut green = SceneRenderer::new(&task, (SIDE, SIDE), Recolour::Skybox).unwrap();
    let (plain, picture) = (plain.render(&mut task), green.render(&mut task));
    let mut seen = [0; 3];
    let pixels = plain.chunks(3).zip(picture.chunks(3));
    for ((before, after), &class) in pixels.zip(green.classes()) {
        seen[class as usize] += 1;
        assert!(!is_key(before));
        if class == Class::Background {
            assert!(is_key(after), "{after:?}");
        }
    }
    assert!(seen.iter().all(|&count| count > 100), "{seen:?}");
}

#[test]
fn every_task_has_a_picture_of_any_size() {
    for id in ids() {
        let mut task = ControlTask::load(id).unwrap();
        task.reset(0).unwrap();
        let assets = SceneRenderer::assets(&task, Recolour::Skybox).unwrap();
        for size in [(SIDE, SIDE), (31, 57)] {
            let mut renderer = SceneRenderer::with_assets(&task, size, assets.clone());
            let picture = renderer.render(&mut task);
            assert_eq!(picture.len(), size.0 * size.1 * 3);
            assert!(renderer.classes().contains(&Class::Body), "{id}");
            assert_eq!(picture, renderer.render(&mut task), "{id}");
        }
    }
}
