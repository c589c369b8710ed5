//! Lights on surfaces.

use super::*;

/// A face of a box, three metres away.
fn wall(material: Material) -> Geom {
    let shape = Shape::Box {
        half: Vec3::new(1.0, 9.0, 9.0),
    };
    geom(shape, [4.0, 0.0, 0.0], material)
}

/// Where the middle of a pixel is on the wall.
fn on_wall(row: usize, column: usize) -> Vec3 {
    let tangent = |index: usize| (MIDDLE as f32 - index as f32) * 2.0 / SIDE as f32;
    Vec3::new(3.0, 3.0 * tangent(column), 3.0 * tangent(row))
}

#[test]
fn matt_surfaces_follow_the_cosine() {
    for angle in [0.0_f32, 0.5, 1.2] {
        let light = sun([angle.cos(), angle.sin(), 0.0]);
        let picture = draw(&scene(vec![wall(matt())], vec![light]));
        assert_near(picture.middle(), [angle.cos(); 3], "cosine");
    }
    let from_behind = draw(&scene(vec![wall(matt())], vec![sun([-1.0, 0.0, 0.0])]));
    assert_eq!(from_behind.middle(), [0, 0, 0]);
}

#[test]
fn a_ball_is_lit_by_its_normals() {
    let ball = geom(Shape::Sphere { radius: 1.0 }, [4.0, 0.0, 0.0], matt());
    let picture = draw(&scene(vec![ball], vec![sun([1.0, 0.0, 0.0])]));
    for column in MIDDLE..MIDDLE + 7 {
        // Where the ray (1, y, 0) t enters the ball around (4, 0, 0).
        let y = (MIDDLE as f32 - column as f32) * 2.0 / SIDE as f32;
        let t = (4.0 - (16.0 - 15.0 * (1.0 + y * y)).sqrt()) / (1.0 + y * y);
        // Between the corners of its facets it is darker, by up to 1.5 %.
        let exact = (4.0 - t) * 255.0;
        let found = f32::from(picture.at(MIDDLE, column)[0]);
        assert!((-4.5..=1.0).contains(&(found - exact)), "{found}, {exact}");
    }
}

#[test]
fn curved_bodies_are_lit_at_the_corners_of_their_facets() {
    let light = Light {
        diffuse: [0.0; 3],
        specular: [1.0; 3],
        ..sun([1.0, 0.0, 0.0])
    };
    let material = Material {
        specular: 1.0,
        shininess: 1.0,
        ..matt()
    };
    let shape = Shape::Cylinder {
        radius: 1.0,
        half_length: 1.0,
    };
    let lit = |turn: f32| {
        let mut tube = geom(shape, [4.0, 0.0, 0.0], material);
        tube.frame.axes[0] = Vec3::new(turn.cos(), turn.sin(), 0.0);
        tube.frame.axes[1] = Vec3::new(-turn.sin(), turn.cos(), 0.0);
        draw(&scene(vec![tube], vec![light])).middle()
    };
    // A row of corners looks at the observer, or the middle of a facet between two.
    let slice = std::f32::consts::TAU / 28.0;
    assert_near(lit(0.0), [1.0; 3], "a corner");
    // Half a slice away the normal is turned by half a slice, sight and light hardly.
    let to_eye = Vec3::new(-3.0, -(0.5 * slice).sin(), 0.0).unit();
    let half = (to_eye + Vec3::new(-1.0, 0.0, 0.0)).unit();
    let normal = Vec3::new(-(0.5 * slice).cos(), (0.5 * slice).sin(), 0.0);
    let expected = normal.dot(half).powf(128.0);
    let between = f32::from(lit(0.5 * slice)[0]) / 255.0;
    assert!((between - expected).abs() < 0.02, "{between}, {expected}");
}

#[test]
fn outlines_are_lit_outside_of_the_form() {
    // The outline is between the left edge and the middle of this pixel.
    let column = MIDDLE + 8;
    let at = |material: Material, light: Light| {
        let ball = geom(Shape::Sphere { radius: 0.934 }, [4.0, 0.0, 0.0], material);
        draw(&scene(vec![ball], vec![light])).at(MIDDLE, column)[0]
    };
    let covered = at(glowing(WHITE), darkness());
    assert!((60..=130).contains(&covered), "{covered}");
    // In the pixel's middle the light of the steep facet has already gone down to nothing.
    let lit = at(matt(), sun([1.0, 0.0, 0.0]));
    assert!(lit <= 3, "{lit}");
}

#[test]
fn colours_of_light_and_surface_multiply_and_stop_at_white() {
    let light = Light {
        ambient: [0.1, 0.2, 0.9],
        diffuse: [0.5, 0.4, 0.3],
        ..sun([1.0, 0.0, 0.0])
    };
    let material = Material {
        rgba: [0.5, 0.25, 1.0, 1.0],
        emission: 0.1,
        ..matt()
    };
    let picture = draw(&scene(vec![wall(material)], vec![light]));
    assert_near(picture.middle(), [0.35, 0.175, 1.0], "colours");
    let dark = draw(&scene(vec![wall(material)], vec![]));
    assert_near(
        dark.middle(),
        [0.2, 0.1, 0.4],
        "without lights there is a weak one",
    );
}

#[test]
fn highlights_are_blinns() {
    let light = Light {
        diffuse: [0.0; 3],
        specular: [0.8; 3],
        ..sun([1.0, 0.0, 0.0])
    };
    let material = Material {
        specular: 0.5,
        ..matt()
    };
    let picture = draw(&scene(vec![wall(material)], vec![light]));
    assert_near(picture.middle(), [0.4; 3], "where light and sight agree");
    for column in [MIDDLE + 3, MIDDLE + 9] {
        let to_eye = -on_wall(MIDDLE, column).unit();
        let half = (to_eye + Vec3::new(-1.0, 0.0, 0.0)).unit();
        let expected = 0.4 * (-half.x).powf(64.0);
        assert_near(picture.at(MIDDLE, column), [expected; 3], "beside");
    }
}

#[test]
fn spots_have_a_cone_and_weaken() {
    let light = Light {
        kind: LightKind::Spot {
            cos_cutoff: 0.9,
            exponent: 10.0,
            attenuation: [1.0, 0.0, 0.25],
        },
        ..sun([1.0, 0.0, 0.0])
    };
    let picture = draw(&scene(vec![wall(matt())], vec![light]));
    for column in [MIDDLE, MIDDLE + 6, MIDDLE + 14, MIDDLE + 17] {
        let point = on_wall(MIDDLE, column);
        let distance = point.norm();
        let cosine = point.x / distance;
        let strength = cosine.powf(10.0) / (1.0 + 0.25 * distance * distance);
        let expected = if cosine < 0.9 { 0.0 } else { strength * cosine };
        assert_near(picture.at(MIDDLE, column), [expected; 3], "spot");
    }
    assert_eq!(picture.at(MIDDLE, MIDDLE + 17), [0, 0, 0]);
}

#[test]
fn planes_are_lit_at_the_corners_of_their_grid() {
    let plane = |spacing: f32| {
        let shape = Shape::Plane {
            half: [6.0, 6.0],
            spacing,
        };
        facing(geom(shape, [3.0, 0.0, 0.0], matt()))
    };
    let light = Light {
        kind: LightKind::Spot {
            cos_cutoff: 0.9,
            exponent: 0.0,
            attenuation: [1.0, 0.0, 0.0],
        },
        position: Vec3::new(0.0, 1.5, 1.5),
        ..sun([1.0, 0.0, 0.0])
    };
    let (row, column) = (MIDDLE - 16, MIDDLE - 16);
    let lit = |spacing| draw(&scene(vec![plane(spacing)], vec![light])).at(row, column);
    assert_near(lit(0.1), [1.0; 3], "a fine grid");
    // The corners of this cell are at 0 and 3 metres, and the cone is narrower.
    assert_eq!(lit(1.5), [0, 0, 0]);
}
