//! The forward camera's picture of the highway, and the class of each of its pixels.
//!
//! Sky and ground are shaded per pixel with analytic filters; everything that stands on the ground is
//! drawn as polygons into a buffer of 2 x 2 samples per pixel and laid over them.

mod camera;
mod colour;
mod drift;
mod ground;
mod light;
mod raster;
mod roadside;
mod sky;
mod vehicles;

use self::camera::Camera;
use self::colour::{Rgb, to_bytes};
use self::ground::Ground;
pub(crate) use self::light::Light;
use self::light::Lighting;
use self::raster::{EMPTY, Raster, SAMPLES};
use crate::environment::class;
use crate::highway::World;

/// Draws pictures of `size` x `size` pixels, and remembers the newest one's classes.
#[derive(Debug, Clone)]
pub(crate) struct Renderer {
    size: usize,
    light: Light,
    raster: Raster,
    backdrop: Vec<Rgb>,
    backdrop_classes: Vec<u8>,
}

impl Renderer {
    pub(crate) fn new(size: usize, light: Light) -> Self {
        Self {
            size,
            light,
            raster: Raster::new(size),
            backdrop: vec![[0.0; 3]; size * size],
            backdrop_classes: vec![class::BACKGROUND; size * size],
        }
    }

    /// The picture `[H, W, 3]` from the ego's camera.
    pub(crate) fn render(&mut self, world: &World) -> Vec<u8> {
        let camera = Camera::on_ego(world.ego.position, world.ego.yaw, self.size);
        let ego_s = world.ego.at.s;
        let fine = Lighting::of(self.light);
        let light = world
            .weather
            .as_ref()
            .map_or(fine, |weather| fine.under(weather));
        sky::draw(&camera, &light, &mut self.backdrop, self.size);
        self.raster.clear();
        roadside::draw(&camera, &light, world.road, ego_s, &mut self.raster);
        vehicles::draw(
            &camera,
            &light,
            world.road,
            &world.traffic.cars,
            &mut self.raster,
        );
        let ground = Ground {
            camera: &camera,
            light: &light,
            road: world.road,
            ego_s,
            covered: &self.raster,
        };
        ground.draw(&mut self.backdrop, &mut self.backdrop_classes, self.size);
        self.compose()
    }

    fn compose(&self) -> Vec<u8> {
        let mut image = Vec::with_capacity(self.size * self.size * 3);
        for y in 0..self.size {
            for x in 0..self.size {
                let backdrop = to_bytes(self.backdrop[y * self.size + x]);
                let samples = self.raster.pixel(x, y);
                if samples == [EMPTY; SAMPLES * SAMPLES] {
                    image.extend(backdrop);
                    continue;
                }
                let mut sums = [0_u32; 3];
                for sample in samples {
                    let colour = if sample == EMPTY {
                        backdrop
                    } else {
                        sample.colour
                    };
                    for (sum, channel) in sums.iter_mut().zip(colour) {
                        *sum += u32::from(channel);
                    }
                }
                let count = (SAMPLES * SAMPLES) as u32;
                image.extend(sums.map(|sum| ((sum + count / 2) / count) as u8));
            }
        }
        image
    }

    /// The [`class`] of each pixel `[H, W]` of the newest picture: the one that most of it shows.
    pub(crate) fn segmentation(&self) -> Vec<u8> {
        let mut classes = Vec::with_capacity(self.size * self.size);
        for y in 0..self.size {
            for x in 0..self.size {
                let backdrop = self.backdrop_classes[y * self.size + x];
                let mut votes = [0_usize; 3];
                for sample in self.raster.pixel(x, y) {
                    let seen = if sample == EMPTY {
                        backdrop
                    } else {
                        sample.class
                    };
                    votes[usize::from(seen)] += 1;
                }
                // In a tie the rarer class wins, so that far cars do not vanish.
                let mut most = class::VEHICLE;
                for candidate in [class::ROAD, class::BACKGROUND] {
                    if votes[usize::from(candidate)] > votes[usize::from(most)] {
                        most = candidate;
                    }
                }
                classes.push(most);
            }
        }
        classes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::highway::{Frenet, Map, Scene, lane_center};

    /// The ego in lane 1 on a straight piece, and one car `ahead` of it in `lane`.
    fn world_with_car(ahead: f64, lane: usize) -> World {
        let mut world = World::new(Scene::new(Map::Loop, Light::Day), 1, 1);
        let s = 1_000.0;
        world.ego.at = Frenet {
            s,
            d: lane_center(1),
        };
        world.ego.position = world.road.to_world(world.ego.at);
        world.ego.yaw = world.road.heading(s);
        let car = &mut world.traffic.cars[0];
        car.lane = lane;
        car.at = Frenet {
            s: s + ahead,
            d: lane_center(lane),
        };
        car.paint = 0;
        world
    }

    fn vehicle_pixels(world: &World, light: Light) -> usize {
        let mut renderer = Renderer::new(64, light);
        renderer.render(world);
        renderer
            .segmentation()
            .iter()
            .filter(|&&seen| seen == class::VEHICLE)
            .count()
    }

    #[test]
    fn a_nearer_car_takes_up_more_pixels_by_day_and_night() {
        for light in [Light::Day, Light::Night] {
            let counts: Vec<usize> = [-20.0, 80.0, 40.0, 20.0, 10.0]
                .map(|ahead| vehicle_pixels(&world_with_car(ahead, 1), light))
                .into();
            assert_eq!(counts[0], 0, "a car behind is not seen");
            assert!(counts[1] >= 1, "{counts:?}");
            assert!(
                counts.windows(2).all(|pair| pair[0] < pair[1]),
                "{counts:?}"
            );
        }
    }

    #[test]
    fn segmentation_marks_the_pixels_that_a_car_changes() {
        let with = world_with_car(12.0, 1);
        let without = world_with_car(-20.0, 1);
        let mut renderer = Renderer::new(64, Light::Day);
        let empty = renderer.render(&without);
        let image = renderer.render(&with);
        let classes = renderer.segmentation();
        let changed: Vec<bool> = (image.chunks(3).zip(empty.chunks(3)))
            .map(|(a, b)| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > 24))
            .collect();
        let marked = classes
            .iter()
            .filter(|&&seen| seen == class::VEHICLE)
            .count();
        let both = (classes.iter().zip(&changed))
            .filter(|&(&seen, &changed)| seen == class::VEHICLE && changed)
            .count();
        // A dark window may look like the asphalt behind it: nearly all is enough.
        assert!(both * 10 >= marked * 9, "{both} of {marked}");
        let shadow_and_edge = changed.iter().filter(|&&changed| changed).count() - both;
        assert!(
            shadow_and_edge * 3 < marked,
            "{shadow_and_edge} beside {marked}"
        );
    }

    #[test]
    fn a_car_in_the_left_lane_is_on_the_left() {
        let column = |lane| {
            let mut renderer = Renderer::new(64, Light::Day);
            renderer.render(&world_with_car(20.0, lane));
            let classes = renderer.segmentation();
            let columns: Vec<usize> = (0..classes.len())
                .filter(|&i| classes[i] == class::VEHICLE)
                .map(|i| i % 64)
                .collect();
            columns.iter().sum::<usize>() as f64 / columns.len() as f64
        };
        assert!(column(2) + 4.0 < column(1) && column(1) + 4.0 < column(0));
    }

    #[test]
    fn brake_lights_show() {
        let red = |acceleration, light| {
            let mut world = world_with_car(10.0, 1);
            world.traffic.cars[0].acceleration = acceleration;
            world.traffic.cars[0].paint = 7;
            let image = Renderer::new(64, light).render(&world);
            let excess = |p: &[u8]| u64::from(p[0].saturating_sub(p[1].max(p[2])));
            image.chunks(3).map(excess).sum::<u64>()
        };
        for light in [Light::Day, Light::Night] {
            assert!(red(-3.0, light) > red(0.0, light) * 11 / 10);
        }
    }

    #[test]
    fn the_sky_is_above_the_horizon_and_the_road_below() {
        let mut renderer = Renderer::new(64, Light::Day);
        renderer.render(&world_with_car(-20.0, 1));
        let classes = renderer.segmentation();
        let road_in_row = |y: usize| {
            classes[y * 64..(y + 1) * 64]
                .iter()
                .filter(|&&c| c == class::ROAD)
                .count()
        };
        assert_eq!((0..24).map(road_in_row).sum::<usize>(), 0);
        assert_eq!(road_in_row(63), 64);
        assert!(road_in_row(36) > 10);
    }

    #[test]
    fn headlights_light_the_near_road() {
        let image = Renderer::new(64, Light::Night).render(&world_with_car(-20.0, 1));
        let brightness = |x: usize, y: usize| u32::from(image[(y * 64 + x) * 3 + 1]);
        assert!(brightness(32, 50) > 2 * brightness(0, 34));
    }

    #[test]
    fn odd_sizes_are_drawn_whole() {
        for size in [9, 65] {
            let mut renderer = Renderer::new(size, Light::Day);
            let image = renderer.render(&world_with_car(15.0, 1));
            assert_eq!(image.len(), size * size * 3);
            assert!(image.chunks(3).all(|pixel| pixel != [0, 0, 0]));
            assert!(renderer.segmentation().contains(&class::VEHICLE));
        }
    }
}
