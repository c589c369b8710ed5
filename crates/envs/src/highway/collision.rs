//! Rigid contacts: between boxes by the separating-axis test, and with the barriers; both by impulses.

use crate::geometry::Vec2;
use crate::highway::car::Car;
use crate::highway::ego::{self, DT, Ego};
use crate::highway::road::{BARRIER_D, Road};

/// Cars crumple: they hardly bounce.
const RESTITUTION: f64 = 0.15;
const FRICTION: f64 = 0.3;
/// Share of its speed along a barrier that whatever grinds along it loses per second: without it, leaning
/// on the barrier would be a way to drive around bends. Not a constant force, which would hold a slow car.
const BARRIER_GRIND_PER_S: f64 = 0.6;
/// A body this close to a barrier still grinds along it.
const GRIND_WITHIN_M: f64 = 0.03;
/// Rounds in which overlaps are taken apart; one suffices unless the ego is pressed between others.
const ROUNDS: usize = 4;

/// A rectangle on the ground.
#[derive(Debug, Clone, Copy)]
struct Rectangle {
    centre: Vec2,
    forward: Vec2,
    half_length: f64,
    half_width: f64,
}

impl Rectangle {
    fn of_ego(ego: &Ego) -> Self {
        Self {
            centre: ego.position,
            forward: ego.forward(),
            half_length: ego::LENGTH / 2.0,
            half_width: ego::WIDTH / 2.0,
        }
    }

    fn of_car(road: &Road, car: &Car) -> Self {
        Self {
            centre: road.to_world(car.at),
            forward: Vec2::from_angle(car.yaw(road)),
            half_length: car.half_length(),
            half_width: car.half_width(),
        }
    }

    fn corners(&self) -> [Vec2; 4] {
        let long = self.forward * self.half_length;
        let wide = self.forward.left() * self.half_width;
        [
            self.centre + long + wide,
            self.centre + long - wide,
            self.centre - long - wide,
            self.centre - long + wide,
        ]
    }

    /// Half the extent along `axis`.
    fn reach(&self, axis: Vec2) -> f64 {
        self.half_length * self.forward.dot(axis).abs()
            + self.half_width * self.forward.left().dot(axis).abs()
    }

    fn contains(&self, point: Vec2) -> bool {
        let offset = point - self.centre;
        offset.dot(self.forward).abs() <= self.half_length
            && offset.dot(self.forward.left()).abs() <= self.half_width
    }
}

#[derive(Debug, Clone, Copy)]
struct Contact {
    /// Unit vector from the first to the second.
    normal: Vec2,
    depth: f64,
    point: Vec2,
}

fn contact(a: &Rectangle, b: &Rectangle) -> Option<Contact> {
    let between = b.centre - a.centre;
    let mut normal = Vec2::default();
    let mut depth = f64::INFINITY;
    for axis in [a.forward, a.forward.left(), b.forward, b.forward.left()] {
        let distance = between.dot(axis);
        let overlap = a.reach(axis) + b.reach(axis) - distance.abs();
        if overlap <= 0.0 {
            return None;
        }
        if overlap < depth {
            depth = overlap;
            normal = if distance < 0.0 { -axis } else { axis };
        }
    }
    let (mut sum, mut count) = (Vec2::default(), 0.0);
    let inside = (b.corners().into_iter().filter(|&corner| a.contains(corner)))
        .chain(a.corners().into_iter().filter(|&corner| b.contains(corner)));
    for corner in inside {
        sum = sum + corner;
        count += 1.0;
    }
    let point = if count > 0.0 {
        sum * (1.0 / count)
    } else {
        a.centre + between * 0.5
    };
    Some(Contact {
        normal,
        depth,
        point,
    })
}

/// Impulses on the ego in one frame, in N s.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Impulses {
    pub(crate) vehicles: f64,
    pub(crate) barriers: f64,
}

/// Resolves every contact of the ego.
pub(crate) fn resolve_ego(road: &Road, ego: &mut Ego, cars: &mut [Car]) -> Impulses {
    let mut impulses = Impulses::default();
    for round in 0..ROUNDS {
        let mut touched = false;
        for car in cars.iter_mut() {
            // Whoever still cannot give way after half the rounds is pressed against something: the ego yields.
            let ego_yields = round >= ROUNDS / 2;
            if let Some(impulse) = hit_car(road, ego, car, ego_yields) {
                impulses.vehicles += impulse;
                touched = true;
            }
        }
        if let Some(impulse) = hit_barrier(road, ego, round == 0) {
            impulses.barriers += impulse;
            touched = true;
        }
        if !touched {
            break;
        }
    }
    impulses
}

fn hit_car(road: &Road, ego: &mut Ego, car: &mut Car, ego_yields: bool) -> Option<f64> {
    let reach = 4.0;
    let distance = road.ahead(ego.at.s, car.at.s).abs();
    if distance > ego::LENGTH / 2.0 + car.half_length() + reach {
        return None;
    }
    let hit = contact(&Rectangle::of_ego(ego), &Rectangle::of_car(road, car))?;
    let car_velocity = car.velocity(road);
    let car_mass = car.build.mass_kg();
    let other = Other {
        velocity: car_velocity,
        inverse_mass: 1.0 / car_mass,
        grind_ns: 0.0,
    };
    let impulse = collide(ego, hit.point, hit.normal, &other);
    car.set_velocity(road, car_velocity - impulse * (1.0 / car_mass));
    car.shove(impulse.norm());

    let ego_share = if ego_yields {
        1.0
    } else {
        car_mass / (car_mass + ego::MASS_KG)
    };
    let apart = hit.normal * (hit.depth + 1e-6);
    ego.position = ego.position - apart * ego_share;
    car.shift(road, apart * (1.0 - ego_share));
    ego.locate(road);
    Some(impulse.norm())
}

fn hit_barrier(road: &Road, ego: &mut Ego, may_grind: bool) -> Option<f64> {
    let (_, half_width) = ego.half_extents(road);
    let centre_d = ego.at.d.abs();
    // A centre beyond the barrier is off the road: nothing holds it there.
    if centre_d + half_width + GRIND_WITHIN_M <= BARRIER_D || centre_d > BARRIER_D {
        return None;
    }
    let side = ego.at.d.signum();
    let reach = if may_grind { GRIND_WITHIN_M } else { 0.0 };
    let (mut deepest, mut point) = (-reach, ego.position);
    for corner in Rectangle::of_ego(ego).corners() {
        let depth = road.project(corner, ego.at.s).d * side - BARRIER_D;
        if depth > deepest {
            deepest = depth;
            point = corner;
        }
    }
    if deepest <= -reach {
        return None;
    }
    let normal = road.tangent(ego.at.s).left() * side;
    let grind_ns = if may_grind {
        BARRIER_GRIND_PER_S * ego.velocity().norm() * ego::MASS_KG * DT
    } else {
        0.0
    };
    let wall = Other {
        velocity: Vec2::default(),
        inverse_mass: 0.0,
        grind_ns,
    };
    let impulse = collide(ego, point, normal, &wall);
    if deepest > 0.0 {
        ego.position = ego.position - normal * (deepest + 1e-6);
        ego.locate(road);
    }
    Some(impulse.norm())
}

/// What the ego touches.
struct Other {
    velocity: Vec2,
    /// 0 for what cannot move.
    inverse_mass: f64,
    /// Greatest impulse along the surface on top of what friction allows.
    grind_ns: f64,
}

/// Applies to the ego, and returns, the impulse of a contact.
fn collide(ego: &mut Ego, point: Vec2, normal: Vec2, other: &Other) -> Vec2 {
    let arm = point - ego.position;
    let at_point = ego.velocity() + arm.left() * ego.spin;
    let relative = at_point - other.velocity;
    let closing = relative.dot(normal).max(0.0);
    let inverse_mass = |axis: Vec2| {
        1.0 / ego::MASS_KG + other.inverse_mass + arm.cross(axis).powi(2) / ego::INERTIA_KG_M2
    };
    let push = (1.0 + RESTITUTION) * closing / inverse_mass(normal);
    let tangent = normal.left();
    let most = FRICTION * push + other.grind_ns;
    let rub = (relative.dot(tangent) / inverse_mass(tangent)).clamp(-most, most);
    let impulse = -(normal * push + tangent * rub);
    ego.set_velocity(ego.velocity() + impulse * (1.0 / ego::MASS_KG));
    ego.spin += arm.cross(impulse) / ego::INERTIA_KG_M2;
    impulse
}

/// Cars farther apart than this at the start of a frame do not touch at its end.
pub(crate) const MAY_TOUCH_M: f64 = 12.0;

/// Takes apart cars that were pushed into each other, of those in `pairs`. The first two that were.
pub(crate) fn separate_cars(
    road: &Road,
    cars: &mut [Car],
    pairs: &[(usize, usize)],
) -> Option<(usize, usize)> {
    let mut touching = None;
    for &(first, second) in pairs {
        let Some(hit) = car_contact(road, &cars[first], &cars[second]) else {
            continue;
        };
        touching = touching.or(Some((first, second)));
        let (mass_a, mass_b) = (cars[first].build.mass_kg(), cars[second].build.mass_kg());
        let velocity_a = cars[first].velocity(road);
        let velocity_b = cars[second].velocity(road);
        let closing = (velocity_a - velocity_b).dot(hit.normal).max(0.0);
        let push = hit.normal * ((1.0 + RESTITUTION) * closing / (1.0 / mass_a + 1.0 / mass_b));
        cars[first].set_velocity(road, velocity_a - push * (1.0 / mass_a));
        cars[second].set_velocity(road, velocity_b + push * (1.0 / mass_b));
        let apart = hit.normal * (0.5 * hit.depth + 1e-6);
        cars[first].shift(road, -apart);
        cars[second].shift(road, apart);
    }
    touching
}

/// A bound of half a car's extent across a straight road; a bend adds less than a quarter of a metre to it.
fn reach_across(car: &Car) -> f64 {
    car.half_width() + car.half_length() * (car.sideways / car.speed.max(4.0)).abs()
}

fn car_contact(road: &Road, a: &Car, b: &Car) -> Option<Contact> {
    // Most pairs are far apart or side by side: this spares their rotations.
    let along = a.half_length() + b.half_length() + 2.0;
    let across = reach_across(a) + reach_across(b) + 0.5;
    if (a.at.d - b.at.d).abs() > across || road.ahead(a.at.s, b.at.s).abs() > along {
        return None;
    }
    contact(&Rectangle::of_car(road, a), &Rectangle::of_car(road, b))
}

/// The first two cars that touch.
#[cfg(test)]
pub(crate) fn first_contact(road: &Road, cars: &[Car]) -> Option<(usize, usize)> {
    (0..cars.len())
        .flat_map(|a| (a + 1..cars.len()).map(move |b| (a, b)))
        .find(|&(a, b)| car_contact(road, &cars[a], &cars[b]).is_some())
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::highway::maps::Map;
    use crate::highway::road::Frenet;

    fn ego_at(s: f64, d: f64, speed: f64) -> Ego {
        let mut ego = Ego::at_rest(Map::Loop.road(), Frenet { s, d });
        ego.speed = speed;
        ego
    }

    fn car_at(s: f64, d: f64, speed: f64) -> Car {
        let mut car = Car::random(&mut ChaCha8Rng::seed_from_u64(4), 1, s);
        car.at.d = d;
        car.speed = speed;
        car
    }

    #[test]
    fn a_rear_end_hit_conserves_momentum_and_takes_both_apart() {
        let road = Map::Loop.road();
        let mut ego = ego_at(100.0, 0.0, 15.0);
        let mut cars = [car_at(104.0, 0.0, 10.0)];
        let mass = cars[0].build.mass_kg();
        let before = ego.velocity() * ego::MASS_KG + cars[0].velocity(road) * mass;
        let impulses = resolve_ego(road, &mut ego, &mut cars);
        let after = ego.velocity() * ego::MASS_KG + cars[0].velocity(road) * mass;
        // The car takes up its new place on the bend, where the same speed along the road points a little elsewhere.
        assert!(
            (before - after).norm() < 1e-3 * before.norm(),
            "{before:?} {after:?}"
        );
        // Head on without an arm: (1 + e) dv / (1/m + 1/M).
        let expected = 1.15 * 5.0 / (1.0 / ego::MASS_KG + 1.0 / mass);
        assert!(
            (impulses.vehicles / expected - 1.0).abs() < 0.02,
            "{impulses:?} {expected}"
        );
        assert!(cars[0].speed > ego.speed);
        assert!(contact(&Rectangle::of_ego(&ego), &Rectangle::of_car(road, &cars[0])).is_none());
        assert_eq!(impulses.barriers, 0.0);
    }

    #[test]
    fn a_car_pressed_against_the_barrier_makes_the_ego_yield() {
        let road = Map::Loop.road();
        let mut cars = [car_at(100.0, 20.0, 5.0)];
        cars[0].shift(road, Vec2::default());
        let mut ego = ego_at(100.0, cars[0].at.d - 1.2, 5.0);
        ego.slip = 3.0;
        resolve_ego(road, &mut ego, &mut cars);
        assert!(cars[0].at.d.abs() + cars[0].half_width() <= BARRIER_D + 1e-9);
        assert!(contact(&Rectangle::of_ego(&ego), &Rectangle::of_car(road, &cars[0])).is_none());
    }

    #[test]
    fn the_barrier_turns_the_ego_along_the_road_and_costs_speed() {
        let road = Map::Loop.road();
        let mut ego = ego_at(100.0, 5.0, 15.0);
        ego.yaw += 0.4;
        let mut impulse = 0.0;
        for _ in 0..60 {
            ego.advance(road, 0.0, 0.0);
            impulse += resolve_ego(road, &mut ego, &mut []).barriers;
            let (_, half_width) = ego.half_extents(road);
            assert!(
                ego.at.d + half_width < BARRIER_D + 0.05,
                "through the barrier"
            );
        }
        assert!(impulse > 3_000.0, "{impulse}");
        assert!(ego.speed < 14.0, "{}", ego.speed);
        assert!(ego.heading_error(road) < 0.2, "{}", ego.heading_error(road));
    }

    #[test]
    fn leaning_on_the_barrier_costs_speed() {
        let road = Map::Loop.road();
        let frames = 100;
        let roll = |ego: &mut Ego| {
            for _ in 0..frames {
                ego.advance(road, 0.0, 0.5);
                resolve_ego(road, ego, &mut []);
            }
            ego.speed
        };
        // Along the outside of a bend the ego leans on the barrier all the time.
        let bend = (0..road.length() as usize).find(|&s| road.curvature(s as f64) > 1.0 / 320.0);
        let s = bend.unwrap() as f64;
        let leaning = roll(&mut ego_at(s, -BARRIER_D + ego::WIDTH / 2.0, 12.0));
        let free = roll(&mut ego_at(s, BARRIER_D - 4.0, 12.0));
        assert!(leaning < 0.6 * free, "{leaning} against {free}");
    }

    #[test]
    fn the_harder_the_shove_the_harder_the_other_driver_brakes_and_not_for_long() {
        let road = Map::Loop.road();
        let after = |ego_speed| {
            let mut cars = [car_at(104.0, 0.0, 10.0)];
            resolve_ego(road, &mut ego_at(100.0, 0.0, ego_speed), &mut cars);
            let [car] = cars;
            car
        };
        let brakes = [10.2, 10.4, 12.0].map(|speed| after(speed).under_shove(1.0));
        assert!(brakes.is_sorted_by(|a, b| a > b), "{brakes:?}");
        assert!(brakes[0] < 0.0 && brakes[2] < -3.0, "{brakes:?}");
        // Nobody brakes to a stop for it, and two seconds later it is forgotten.
        let mut car = after(30.0);
        let speed = std::mem::replace(&mut car.speed, 0.3);
        assert_eq!(car.under_shove(1.0), 1.0);
        car.speed = speed;
        for _ in 0..40 {
            car.advance(road);
        }
        assert!(car.under_shove(1.0) > 0.9);
    }

    #[test]
    fn no_contact_no_impulse() {
        let road = Map::Loop.road();
        let mut ego = ego_at(100.0, 0.0, 15.0);
        let before = ego.clone();
        let impulses = resolve_ego(
            road,
            &mut ego,
            &mut [car_at(106.0, 0.0, 1.0), car_at(100.0, 3.5, 1.0)],
        );
        assert_eq!(impulses, Impulses::default());
        assert_eq!(ego, before);
    }
}
