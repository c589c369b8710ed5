//! Cars as shaded boxes with windows, wheels, lamps and a shadow.

use super::camera::{Camera, ViewPoint};
use super::colour::{Rgb, scale};
use super::light::{Facing, Light, Lighting};
use super::raster::{Layer, Raster};
use crate::environment::class;
use crate::geometry::Vec2;
use crate::highway::{Build, Car, Road};

/// Farther cars are less than a sample wide.
const VISIBLE_M: f64 = 260.0;
/// Farther cars are drawn without details.
const DETAILED_M: f32 = 90.0;
/// Braking from which the brake lights show.
const BRAKE_LIGHT_M_S2: f64 = 0.6;

/// No grey among them: a car must not look like the road.
const PAINTS: [Rgb; 10] = [
    [0.85, 0.10, 0.10],
    [0.95, 0.95, 0.96],
    [0.10, 0.25, 0.80],
    [0.97, 0.80, 0.10],
    [0.05, 0.60, 0.65],
    [0.95, 0.48, 0.08],
    [0.50, 0.15, 0.65],
    [0.07, 0.07, 0.09],
    [0.10, 0.55, 0.20],
    [0.90, 0.35, 0.55],
];
const GLASS: Rgb = [0.10, 0.14, 0.20];
const RUBBER: Rgb = [0.05, 0.05, 0.06];
const SHADOW: Rgb = [0.13, 0.13, 0.14];
const TAIL_LAMP: Rgb = [0.62, 0.05, 0.05];
const TAIL_LAMP_GLOW: Rgb = [0.75, 0.04, 0.03];
const BRAKE_LAMP: Rgb = [1.0, 0.22, 0.14];
const HEAD_LAMP: Rgb = [1.0, 0.98, 0.85];

/// A car's place in the camera's view.
struct Pose {
    centre: ViewPoint,
    forward: ViewPoint,
    left: ViewPoint,
}

impl Pose {
    /// A point in the car's own metres: ahead, left, above the ground.
    fn point(&self, ahead: f32, left: f32, up: f32) -> ViewPoint {
        let mut point: ViewPoint =
            std::array::from_fn(|i| self.centre[i] + self.forward[i] * ahead + self.left[i] * left);
        point[1] += up;
        point
    }
}

/// A box whose top may be smaller than its bottom.
#[derive(Clone, Copy)]
struct Block {
    bottom: f32,
    top: f32,
    /// Rear and front at the bottom and at the top.
    bottom_x: [f32; 2],
    top_x: [f32; 2],
    /// Half the width at the bottom and at the top.
    bottom_y: f32,
    top_y: f32,
}

impl Block {
    fn straight(bottom: f32, top: f32, x: [f32; 2], y: f32) -> Self {
        Self {
            bottom,
            top,
            bottom_x: x,
            top_x: x,
            bottom_y: y,
            top_y: y,
        }
    }
}

struct Brush<'a> {
    camera: &'a Camera,
    light: &'a Lighting,
    raster: &'a mut Raster,
    pose: Pose,
}

impl Brush<'_> {
    fn face(&mut self, corners: [ViewPoint; 4], albedo: Rgb, facing: Facing, layer: Layer) {
        let colour = self.light.shade(albedo, self.pose.centre, facing);
        self.raster
            .fill(self.camera, &corners, colour, class::VEHICLE, layer);
    }

    fn block(&mut self, block: &Block, sides: Rgb, top: Rgb) {
        let at = |end: usize, side: f32, upper: bool| {
            let (x, y, z) = if upper {
                (block.top_x[end], block.top_y, block.top)
            } else {
                (block.bottom_x[end], block.bottom_y, block.bottom)
            };
            self.pose.point(x, y * side, z)
        };
        let (left, right) = (1.0, -1.0);
        let rear = [
            at(0, left, false),
            at(0, right, false),
            at(0, right, true),
            at(0, left, true),
        ];
        let front = [
            at(1, right, false),
            at(1, left, false),
            at(1, left, true),
            at(1, right, true),
        ];
        let on_left = [
            at(1, left, false),
            at(0, left, false),
            at(0, left, true),
            at(1, left, true),
        ];
        let on_right = [
            at(0, right, false),
            at(1, right, false),
            at(1, right, true),
            at(0, right, true),
        ];
        let above = [
            at(0, left, true),
            at(0, right, true),
            at(1, right, true),
            at(1, left, true),
        ];
        self.face(rear, sides, Facing::Camera, Layer::Solid);
        self.face(front, sides, Facing::Camera, Layer::Solid);
        self.face(on_left, sides, Facing::Side, Layer::Solid);
        self.face(on_right, sides, Facing::Side, Layer::Solid);
        self.face(above, top, Facing::Up, Layer::Solid);
    }

    /// A rectangle on the rear (`x` negative) or front, from `y[0]` on the left to `y[1]`.
    fn panel(&mut self, x: f32, y: [f32; 2], z: [f32; 2], colour: Rgb) {
        let y = if x < 0.0 { y } else { [y[1], y[0]] };
        let corners = [
            self.pose.point(x, y[0], z[0]),
            self.pose.point(x, y[1], z[0]),
            self.pose.point(x, y[1], z[1]),
            self.pose.point(x, y[0], z[1]),
        ];
        self.raster
            .fill(self.camera, &corners, colour, class::VEHICLE, Layer::Detail);
    }

    fn shadow(&mut self, half_length: f32, half_width: f32) {
        let (x, y) = (half_length + 0.15, half_width + 0.15);
        let corners = [
            self.pose.point(-x, y, 0.01),
            self.pose.point(-x, -y, 0.01),
            self.pose.point(x, -y, 0.01),
            self.pose.point(x, y, 0.01),
        ];
        let colour = self.light.shade(SHADOW, self.pose.centre, Facing::Ground);
        self.raster
            .fill(self.camera, &corners, colour, class::ROAD, Layer::Solid);
    }
}

/// Draws `cars` as the camera sees them.
pub(super) fn draw(
    camera: &Camera,
    light: &Lighting,
    road: &Road,
    cars: &[Car],
    raster: &mut Raster,
) {
    for car in cars {
        let position = road.to_world(car.at);
        let offset = position - camera.eye;
        let ahead = offset.dot(camera.forward);
        let aside = offset.dot(camera.right()).abs();
        // Outside of a field of view of 60 degrees, with room for half a car.
        if !(-3.0..VISIBLE_M).contains(&ahead) || aside > 0.6 * ahead + 8.0 {
            continue;
        }
        let forward = Vec2::from_angle(car.yaw(road));
        let pose = Pose {
            centre: camera.view(position, 0.0),
            forward: camera.direction(forward),
            left: camera.direction(forward.left()),
        };
        let mut brush = Brush {
            camera,
            light,
            raster,
            pose,
        };
        draw_car(&mut brush, car);
    }
}

fn draw_car(brush: &mut Brush<'_>, car: &Car) {
    let [length, width, height] = car.build.size().map(|metres| metres as f32);
    let (x, y) = (length / 2.0, width / 2.0);
    let paint = PAINTS[usize::from(car.paint) % PAINTS.len()];
    let belt = belt_height(car.build);

    brush.shadow(x, y);
    let wheels = Block::straight(0.0, 0.4, [-x + 0.25, x - 0.25], y - 0.08);
    brush.block(&wheels, RUBBER, RUBBER);
    let body = Block::straight(0.28, belt, [-x, x], y);
    brush.block(&body, paint, paint);
    let cabin = cabin(car.build, x, y, belt, height);
    let is_detailed = brush.pose.centre[2] < DETAILED_M;
    if car.build == Build::Van {
        brush.block(&cabin, paint, scale(paint, 1.05));
        let glass = brush.light.shade(GLASS, brush.pose.centre, Facing::Camera);
        brush.panel(-x, [0.8 * y, -0.8 * y], [belt + 0.1, height - 0.25], glass);
    } else {
        brush.block(&cabin, GLASS, scale(paint, 1.05));
        if is_detailed {
            pillars(brush, &cabin, paint);
        }
    }
    if is_detailed {
        lamps(brush, car, x, y, belt);
    }
}

fn belt_height(build: Build) -> f32 {
    match build {
        Build::Compact | Build::Sedan => 0.9,
        Build::Suv => 1.08,
        Build::Van => 1.45,
    }
}

fn cabin(build: Build, x: f32, y: f32, belt: f32, height: f32) -> Block {
    let (bottom_x, top_x) = match build {
        Build::Compact => ([-x, 0.35 * x], [-0.8 * x, 0.05 * x]),
        Build::Sedan => ([-0.75 * x, 0.4 * x], [-0.45 * x, 0.1 * x]),
        Build::Suv => ([-x, 0.4 * x], [-0.88 * x, 0.15 * x]),
        Build::Van => ([-x, 0.75 * x], [-x, 0.5 * x]),
    };
    Block {
        bottom: belt,
        top: height,
        bottom_x,
        top_x,
        bottom_y: y * 0.97,
        top_y: y * if build == Build::Van { 0.93 } else { 0.78 },
    }
}

fn lamps(brush: &mut Brush<'_>, car: &Car, x: f32, y: f32, belt: f32) {
    let brakes = car.acceleration < -BRAKE_LIGHT_M_S2;
    let (tail, head) = match (brakes, brush.light.light) {
        (true, _) => (BRAKE_LAMP, HEAD_LAMP),
        (false, Light::Night) => (TAIL_LAMP_GLOW, HEAD_LAMP),
        (false, Light::Day) => (TAIL_LAMP, scale(HEAD_LAMP, 0.9)),
    };
    // Lamps shine by themselves: only the air dims them.
    let distance = brush.pose.centre[2];
    let tail = brush.light.through_air(tail, distance);
    let head = brush.light.through_air(head, distance);
    let z = [belt - 0.30, belt - 0.08];
    for side in [1.0, -1.0] {
        let (inner, outer) = (side * (y - 0.5), side * (y - 0.03));
        let span = if side > 0.0 {
            [outer, inner]
        } else {
            [inner, outer]
        };
        brush.panel(-x, span, z, tail);
        brush.panel(x, span, z, head);
    }
    if brakes {
        brush.panel(-x, [0.3, -0.3], [belt - 0.12, belt - 0.02], tail);
    }
    let plate = brush
        .light
        .shade([0.85, 0.85, 0.8], brush.pose.centre, Facing::Camera);
    brush.panel(-x, [0.26, -0.26], [0.45, 0.58], plate);
}

/// Frames the rear window in the car's own paint.
fn pillars(brush: &mut Brush<'_>, cabin: &Block, paint: Rgb) {
    let colour = brush.light.shade(paint, brush.pose.centre, Facing::Camera);
    for side in [1.0_f32, -1.0] {
        let (b, t) = (cabin.bottom_y * side, cabin.top_y * side);
        let width = 0.16 * side;
        let mut corners = [
            brush.pose.point(cabin.bottom_x[0], b, cabin.bottom),
            brush.pose.point(cabin.bottom_x[0], b - width, cabin.bottom),
            brush.pose.point(cabin.top_x[0], t - width, cabin.top),
            brush.pose.point(cabin.top_x[0], t, cabin.top),
        ];
        if side < 0.0 {
            corners.reverse();
        }
        brush.raster.fill(
            brush.camera,
            &corners,
            colour,
            class::VEHICLE,
            Layer::Detail,
        );
    }
}
