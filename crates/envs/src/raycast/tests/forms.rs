//! Outlines and depths of all forms.

use super::*;

/// At this distance from the observer is the middle of every form.
const DISTANCE: f32 = 4.0;

/// Half the side of a ball's outline, as a tangent.
fn ball(radius: f32) -> f32 {
    radius / (DISTANCE * DISTANCE - radius * radius).sqrt()
}

/// Two triangles that make a square of half size `half` which faces the observer.
fn square(half: f32) -> Mesh {
    let corner = |y: f32, z: f32| Vec3::new(0.0, y * half, z * half);
    let triangle = |corners| Triangle {
        corners,
        normals: [Vec3::new(-1.0, 0.0, 0.0); 3],
        texture: None,
    };
    let [a, b, c, d] = [
        corner(-1.0, -1.0),
        corner(-1.0, 1.0),
        corner(1.0, 1.0),
        corner(1.0, -1.0),
    ];
    Mesh::new(vec![triangle([a, b, c]), triangle([a, c, d])])
}

fn assets() -> Assets {
    Assets {
        meshes: vec![square(1.0)],
        ..Assets::default()
    }
}

/// Every form with the half width and half height of its outline and the distance of its front.
fn forms() -> Vec<(Geom, [f32; 2], f32)> {
    let at = |shape| geom(shape, [DISTANCE, 0.0, 0.0], glowing(WHITE));
    let box_front = DISTANCE - 0.5;
    vec![
        (at(Shape::Sphere { radius: 1.0 }), [ball(1.0); 2], 3.0),
        (
            at(Shape::Ellipsoid {
                radii: Vec3::new(0.5, 1.0, 2.0),
            }),
            // The ellipse in a plane through the eye: b / sqrt(d^2 - a^2).
            [1.0, 2.0].map(|radius| radius / (16.0_f32 - 0.25).sqrt()),
            3.5,
        ),
        (
            at(Shape::Capsule {
                radius: 0.5,
                half_length: 1.0,
            }),
            [
                ball(0.5),
                (1.0 + 0.5 * (1.0 + 0.31 * 0.31_f32).sqrt()) / DISTANCE,
            ],
            3.5,
        ),
        (
            at(Shape::Cylinder {
                radius: 0.5,
                half_length: 1.0,
            }),
            [ball(0.5), 1.0 / box_front],
            3.5,
        ),
        (
            at(Shape::Box {
                half: Vec3::new(0.5, 1.0, 2.0),
            }),
            [1.0 / box_front, 2.0 / box_front],
            3.5,
        ),
        (
            facing(at(Shape::Plane {
                half: [1.0, 2.0],
                spacing: 1.0,
            })),
            [0.25, 0.5],
            4.0,
        ),
        (at(Shape::Mesh { index: 0 }), [0.25, 0.25], 4.0),
    ]
}

#[test]
fn outlines_are_where_geometry_has_them() {
    for (geom, half, _) in forms() {
        let name = format!("{:?}", geom.shape);
        let class = geom.class;
        let picture = draw_with(assets(), &scene(vec![geom], vec![darkness()]));
        let size = picture.white();
        for axis in 0..2 {
            // Samples are a quarter of a pixel apart.
            let error = (size[axis] - 2.0 * half[axis]).abs();
            assert!(error < 1.0 / SIDE as f32, "{name}: {size:?}, {half:?}");
        }
        assert_eq!(picture.class(MIDDLE, MIDDLE), class, "{name}");
        assert_eq!(picture.class(0, 0), Class::Background, "{name}");
    }
}

#[test]
fn fronts_are_at_their_distance() {
    for (form, _, front) in forms() {
        let screen = |distance: f32| {
            let shape = Shape::Plane {
                half: [9.0, 9.0],
                spacing: 1.0,
            };
            facing(geom(
                shape,
                [distance, 0.0, 0.0],
                glowing([1.0, 0.0, 0.0, 1.0]),
            ))
        };
        let middle = |distance: f32| {
            let geoms = vec![form.clone(), screen(distance)];
            draw_with(assets(), &scene(geoms, vec![darkness()])).middle()
        };
        assert_eq!(middle(front - 0.002), [255, 0, 0], "{:?}", form.shape);
        assert_eq!(middle(front + 0.002), [255, 255, 255], "{:?}", form.shape);
    }
}

#[test]
fn turned_forms_look_turned() {
    let capsule = Shape::Capsule {
        radius: 0.2,
        half_length: 1.0,
    };
    let mut lying = geom(capsule, [DISTANCE, 0.0, 0.0], glowing(WHITE));
    lying.frame.axes = [
        Vec3::new(1.0, 0.0, 0.0),
        Vec3::new(0.0, 0.0, -1.0),
        Vec3::new(0.0, 1.0, 0.0),
    ];
    let [width, height] = draw(&scene(vec![lying], vec![darkness()])).white();
    assert!(width > 0.55 && height < 0.12, "{width} x {height}");
    // Along its own axis it is a disc.
    let mut away = geom(capsule, [DISTANCE, 0.0, 0.0], glowing(WHITE));
    away = facing(away);
    let [width, height] = draw(&scene(vec![away], vec![darkness()])).white();
    assert!(
        (width - height).abs() < 1e-6 && width < 0.2,
        "{width} x {height}"
    );
}

#[test]
fn half_a_pixel_is_half_a_colour() {
    // The edge of the box runs through the middle of the pixels of a column.
    let shape = Shape::Box {
        half: Vec3::new(0.5, 4.0, 4.0),
    };
    let picture = draw(&scene(
        vec![geom(shape, [4.5, -4.0, 0.0], glowing(WHITE))],
        vec![darkness()],
    ));
    assert_eq!(picture.at(MIDDLE, MIDDLE - 1), [0, 0, 0]);
    assert_eq!(picture.at(MIDDLE, MIDDLE), [128, 128, 128]);
    assert_eq!(picture.at(MIDDLE, MIDDLE + 1), [255, 255, 255]);
}

#[test]
fn nothing_is_seen_from_inside_or_behind() {
    let around = geom(Shape::Sphere { radius: 2.0 }, [0.0; 3], glowing(WHITE));
    let behind = geom(
        Shape::Sphere { radius: 1.0 },
        [-4.0, 0.0, 0.0],
        glowing(WHITE),
    );
    let picture = draw(&scene(vec![around, behind], vec![darkness()]));
    assert!(picture.bytes.iter().all(|&value| value == 0));
}
