//! Shadows, mirrors, transparency, and what every picture has to be.

use super::*;

/// A floor a metre below the observer.
fn floor(material: Material) -> Geom {
    let shape = Shape::Plane {
        half: [10.0, 10.0],
        spacing: 0.1,
    };
    geom(shape, [0.0, 0.0, -1.0], material)
}

/// The row that shows the floor at `distance` metres.
fn floor_row(distance: f32) -> usize {
    ((1.0 + 1.0 / distance) * 0.5 * SIDE as f32) as usize
}

/// Where the middle of a row is on the floor.
fn floor_x(row: usize) -> f32 {
    SIDE as f32 / (2.0 * (row - MIDDLE) as f32)
}

fn shadowing(light: Light, reach: f32) -> Light {
    Light {
        position: Vec3::new(3.0, 0.0, 4.0),
        shadow: Some(reach),
        ..light
    }
}

#[test]
fn shadows_are_below_what_throws_them() {
    let spot = Light {
        kind: LightKind::Spot {
            cos_cutoff: 0.5,
            exponent: 0.0,
            attenuation: [1.0, 0.0, 0.0],
        },
        ..sun([0.0, 0.0, -1.0])
    };
    // Half the way down, so that the spot's shadow is twice as large as the body.
    let body = Shape::Box {
        half: Vec3::new(0.25, 0.25, 0.01),
    };
    for (light, half) in [(sun([0.0, 0.0, -1.0]), 0.25), (spot, 0.5)] {
        let body = geom(body, [3.0, 0.0, 1.5], matt());
        let picture = draw(&scene(
            vec![floor(matt()), body],
            vec![shadowing(light, 9.0)],
        ));
        for row in floor_row(5.0)..SIDE {
            let x = floor_x(row);
            let dark = (x - 3.0).abs();
            if (dark - half).abs() < 0.02 {
                continue;
            }
            let is_dark = picture.at(row, MIDDLE)[0] < 10;
            assert_eq!(is_dark, dark < half, "{:?}: row {row} at {x}", light.kind);
        }
    }
}

#[test]
fn shadows_end_where_the_light_has_none() {
    let body = Shape::Box {
        half: Vec3::new(0.5, 0.5, 0.01),
    };
    let body = geom(body, [3.0, 0.0, 1.5], matt());
    let light = sun([0.0, 0.0, -1.0]);
    let at = |light: Light| {
        let geoms = vec![floor(matt()), body.clone()];
        draw(&scene(geoms, vec![light])).at(floor_row(2.7), MIDDLE)
    };
    assert_eq!(at(shadowing(light, 1.0)), [0, 0, 0]);
    assert_eq!(
        at(shadowing(light, 0.2)),
        [255, 255, 255],
        "beyond the light's reach"
    );
    assert_eq!(at(light), [255, 255, 255], "a light without shadows");
}

#[test]
fn bodies_shade_bodies() {
    let table = Shape::Box {
        half: Vec3::new(1.0, 1.0, 0.5),
    };
    let table = geom(table, [3.0, 0.0, -1.5], matt());
    let ball = geom(Shape::Sphere { radius: 0.3 }, [3.0, 0.0, 1.0], matt());
    let light = shadowing(sun([0.0, 0.0, -1.0]), 9.0);
    let picture = draw(&scene(vec![table, ball], vec![light]));
    assert_eq!(picture.at(floor_row(3.0), MIDDLE), [0, 0, 0]);
    assert_eq!(picture.at(floor_row(2.4), MIDDLE), [255, 255, 255]);
}

#[test]
fn mirrors_add_what_is_above_them() {
    let mirror = Material {
        rgba: [0.5, 0.5, 0.5, 1.0],
        reflectance: 0.4,
        ..glowing(WHITE)
    };
    // Mirrored in the floor at -1 it is seen around z = -2.5.
    let shape = Shape::Box {
        half: Vec3::new(0.1, 0.5, 0.25),
    };
    let body = geom(shape, [3.0, 0.0, 0.5], glowing([1.0, 0.5, 0.0, 1.0]));
    let below = geom(shape, [3.0, 0.0, -1.5], glowing(WHITE));
    let picture = draw(&scene(
        vec![floor(mirror), body.clone(), below],
        vec![darkness()],
    ));
    let row = |tangent: f32| ((1.0 + tangent) * 0.5 * SIDE as f32) as usize;
    let mirrored = row(2.5 / 2.9);
    assert_near(picture.at(mirrored, MIDDLE), [0.9, 0.7, 0.5], "mirrored");
    assert_eq!(picture.class(mirrored, MIDDLE), Class::Floor);
    assert_near(picture.at(mirrored, 5), [0.5; 3], "beside it");
    assert_near(
        picture.at(row(1.5 / 2.9), MIDDLE),
        [0.5; 3],
        "what is below the floor",
    );
    let stage = Shape::Box {
        half: Vec3::new(2.5, 10.0, 0.5),
    };
    let stage = geom(stage, [4.5, 0.0, -1.5], mirror);
    let picture = draw(&scene(vec![stage, body.clone()], vec![darkness()]));
    assert_near(
        picture.at(row(1.2 / 2.5), MIDDLE),
        [0.5; 3],
        "the top, nothing above",
    );
    assert_near(picture.at(mirrored, MIDDLE), [0.5; 3], "the side of a box");
    // A second mirror mirrors nothing.
    let second = draw(&scene(
        vec![
            geom(
                Shape::Box {
                    half: Vec3::new(0.01, 0.01, 0.01),
                },
                [-5.0, 0.0, 0.0],
                mirror,
            ),
            floor(mirror),
            body,
        ],
        vec![darkness()],
    ));
    assert_near(second.at(mirrored, MIDDLE), [0.5; 3], "a second mirror");
}

#[test]
fn transparent_geoms_are_blended_twice() {
    let shape = Shape::Box {
        half: Vec3::new(0.1, 1.0, 1.0),
    };
    let behind = geom(shape, [4.0, 0.0, 0.0], glowing([0.0, 0.0, 1.0, 1.0]));
    let pane = |x: f32, colour: [f32; 4]| geom(shape, [x, 0.0, 0.0], glowing(colour));
    let middle = |geoms| draw(&scene(geoms, vec![darkness()])).middle();
    let red = pane(2.0, [1.0, 0.0, 0.0, 0.5]);
    assert_near(
        middle(vec![red.clone(), behind.clone()]),
        [0.75, 0.0, 0.25],
        "one pane",
    );
    // Near, far, far, near: MuJoCo's order.
    let green = pane(3.0, [0.0, 1.0, 0.0, 0.5]);
    let two = middle(vec![green, red, behind.clone()]);
    assert_near(two, [0.5 + 0.0625, 0.375, 0.0625], "two panes");
    let hidden = pane(5.0, [1.0, 0.0, 0.0, 0.5]);
    assert_near(
        middle(vec![behind, hidden]),
        [0.0, 0.0, 1.0],
        "a pane behind",
    );
}

#[test]
fn planes_fade_seen_from_behind() {
    let mut ceiling = floor(glowing(WHITE));
    ceiling.frame.position.z = 1.0;
    let picture = draw(&scene(vec![ceiling], vec![darkness()]));
    assert_near(picture.at(2, MIDDLE), [1.0 - 0.7 * 0.7; 3], "from behind");
}

/// Something of everything.
fn crowded() -> Scene {
    let mirror = Material {
        reflectance: 0.3,
        ..matt()
    };
    let capsule = Shape::Capsule {
        radius: 0.3,
        half_length: 0.5,
    };
    let glass = Material {
        rgba: [0.2, 0.9, 0.4, 0.6],
        ..matt()
    };
    let mut scene = scene(
        vec![
            floor(mirror),
            geom(capsule, [3.0, 0.4, 0.0], matt()),
            geom(Shape::Sphere { radius: 0.4 }, [2.0, -0.5, 0.1], glass),
        ],
        vec![shadowing(sun([0.3, 0.1, -1.0]), 9.0), sun([1.0, 0.0, 0.0])],
    );
    scene.camera.up = Vec3::new(0.0, 0.1, 1.0).unit();
    scene
}

#[test]
fn a_picture_depends_on_its_scene_alone() {
    let scene = crowded();
    let mut other = scene.clone();
    other.camera.position = Vec3::new(0.5, 0.2, 0.3);
    other.camera.forward = Vec3::new(1.0, -0.3, -0.4).unit();
    other.geoms.remove(1);
    let mut renderer = Renderer::new(Arc::new(Assets::default()), SIDE, SIDE);
    let first = renderer.render(&scene);
    let between = renderer.render(&other);
    assert_ne!(first, between);
    assert_eq!(renderer.render(&scene), first);
    assert_eq!(draw(&other).bytes, between);
}

#[test]
fn pictures_have_any_size() {
    let scene = crowded();
    let mean = |height: usize, width: usize| {
        let mut renderer = Renderer::new(Arc::new(Assets::default()), height, width);
        let bytes = renderer.render(&scene);
        assert_eq!(bytes.len(), height * width * 3);
        assert_eq!(renderer.classes().len(), height * width);
        assert_eq!(renderer.size(), (height, width));
        bytes.iter().map(|&value| f64::from(value)).sum::<f64>() / bytes.len() as f64
    };
    let small = mean(32, 32);
    assert!(small > 20.0, "{small}");
    for side in [64, 200] {
        let large = mean(side, side);
        assert!((large - small).abs() < 2.0, "{side}: {large}, not {small}");
    }
    mean(1, 1);
    mean(7, 50);
}
