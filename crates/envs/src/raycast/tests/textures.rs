//! Textures on geoms and around them.

use super::*;

const RED: [u8; 3] = [255, 0, 0];
const BLUE: [u8; 3] = [0, 0, 255];

/// Red on the left, blue on the right.
fn halves() -> Texture {
    Texture::new(2, 1, vec![RED, BLUE])
}

fn textured(repeat: [f32; 2], uniform: bool) -> Material {
    Material {
        texture: Some(TextureUse {
            index: 0,
            repeat,
            uniform,
        }),
        ..glowing(WHITE)
    }
}

fn draw_textured(surface: Surface, geom: Geom) -> Picture {
    let assets = Assets {
        textures: vec![surface],
        ..Assets::default()
    };
    draw_with(assets, &scene(vec![geom], vec![darkness()]))
}

/// A square that fills the view of the middle half.
fn screen(material: Material) -> Geom {
    let shape = Shape::Plane {
        half: [2.0, 2.0],
        spacing: 1.0,
    };
    // Its x axis points to the right of the picture.
    facing(geom(shape, [4.0, 0.0, 0.0], material))
}

#[test]
fn a_texture_begins_at_the_edge_of_its_plane() {
    let wide = |repeat, uniform| {
        draw_textured(
            Surface::Flat(halves()),
            screen(textured([repeat, 1.0], uniform)),
        )
    };
    // Near the texels' middles, a quarter and three quarters from the left edge.
    let [left, right] = [MIDDLE - 8, MIDDLE + 8];
    let once = wide(1.0, false);
    assert_near(once.at(MIDDLE, left), [0.992, 0.0, 0.008], "left half");
    assert_near(once.at(MIDDLE, right), [0.008, 0.0, 0.992], "right half");
    assert_near(once.middle(), [0.5, 0.0, 0.5], "between");
    // Half a repetition per metre and four metres: two.
    let twice = wide(1.0, true);
    let again = wide(2.0, false);
    assert_eq!(twice.bytes, again.bytes);
    assert_near(twice.middle(), [0.5, 0.0, 0.5], "between repetitions");
    assert!(twice.at(MIDDLE, MIDDLE - 12)[0] > 200 && twice.at(MIDDLE, MIDDLE - 4)[2] > 200);
}

#[test]
fn what_is_too_fine_is_mixed() {
    let picture = draw_textured(
        Surface::Flat(halves()),
        screen(textured([64.0, 1.0], false)),
    );
    assert_near(picture.at(MIDDLE, MIDDLE + 5), [0.5, 0.0, 0.5], "mipmap");
}

#[test]
fn a_cube_surrounds_a_geom() {
    let colours = [
        RED,
        BLUE,
        [0, 255, 0],
        [255, 255, 0],
        [255, 0, 255],
        [0, 255, 255],
    ];
    let cube = || CubeTexture::new(colours.map(Texture::plain));
    let ball = geom(
        Shape::Sphere { radius: 1.0 },
        [4.0, 0.0, 0.0],
        textured([1.0, 1.0], false),
    );
    let picture = draw_textured(Surface::Cube(cube()), ball);
    assert_eq!(
        picture.middle(),
        BLUE,
        "the side towards the observer is -x"
    );
    // As a sky it lies on its side: its y is up.
    let look = |forward: [f32; 3], up: [f32; 3]| {
        let mut scene = scene(vec![], vec![]);
        scene.camera.forward = forward.into();
        scene.camera.up = up.into();
        let assets = Assets {
            sky: Some(cube()),
            ..Assets::default()
        };
        draw_with(assets, &scene).middle()
    };
    let (up, north) = ([0.0, 0.0, 1.0], [0.0, 1.0, 0.0]);
    assert_eq!(look([1.0, 0.0, 0.0], up), colours[0]);
    assert_eq!(look([-1.0, 0.0, 0.0], up), colours[1]);
    assert_eq!(look(up, north), colours[2]);
    assert_eq!(look([0.0, 0.0, -1.0], north), colours[3]);
    assert_eq!(look([0.0, -1.0, 0.0], up), colours[4]);
    assert_eq!(look(north, up), colours[5]);
}

#[test]
fn a_mesh_has_its_own_coordinates() {
    let corner = |y: f32, z: f32| Vec3::new(0.0, y, z);
    let triangle = Triangle {
        corners: [corner(9.0, -9.0), corner(-9.0, -9.0), corner(0.0, 9.0)],
        normals: [Vec3::new(-1.0, 0.0, 0.0); 3],
        texture: Some([[0.25, 0.5]; 3]),
    };
    let assets = Assets {
        textures: vec![Surface::Flat(halves())],
        meshes: vec![Mesh::new(vec![triangle])],
        sky: None,
    };
    let shape = Shape::Mesh { index: 0 };
    let geom = geom(shape, [4.0, 0.0, 0.0], textured([1.0, 1.0], false));
    let picture = draw_with(assets, &scene(vec![geom], vec![darkness()]));
    assert_eq!(picture.middle(), RED);
}
