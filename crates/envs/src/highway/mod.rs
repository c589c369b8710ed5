//! The highway: a four-lane road full of traffic, driven by steering and pedals from a forward camera.
//!
//! A stand-in for the CARLA setup of the Iso-Dream++ paper (Town04, 30 vehicles, 20 frames/s): same
//! action, camera, reward and ends, on own physics.

mod car;
mod collision;
mod column;
mod ego;
pub(crate) mod family;
mod following;
mod jam;
mod lane_change;
mod maps;
mod metrics;
mod reward;
mod road;
mod scene;
mod soak;
mod spawn;
mod traffic;
mod weather;
mod world;

use isodream_core::EnvSpec;
use isodream_core::config::{EnvConfig, RepeatReward};

pub(crate) use self::car::{Build, Car};
#[cfg(test)]
pub(crate) use self::maps::Map;
#[cfg(test)]
pub(crate) use self::road::lane_center;
pub(crate) use self::road::{BARRIER_D, Frenet, LANE_WIDTH, LANES, LANES_HALF_WIDTH, Road};
pub(crate) use self::scene::Scene;
pub use self::soak::{TrafficReport, traffic_without_collisions};
pub(crate) use self::weather::Weather;
#[cfg(test)]
pub(crate) use self::weather::tests::weather;
pub(crate) use self::world::World;

use crate::environment::{EndReason, PrivilegedView};
use crate::render::Renderer;
use crate::{EnvError, Environment, Transition};

/// More cars than this do not fit into the traffic's window.
pub(crate) const MAX_VEHICLES: u32 = 60;

/// The highway environment. Action: `[steer, pedal]`, steer 1 is full right, pedal 1 full throttle and -1 full brake.
pub(crate) struct Highway {
    spec: EnvSpec,
    scene: Scene,
    repeat_reward: RepeatReward,
    vehicles: u32,
    weather_drift: bool,
    renderer: Renderer,
    world: Option<World>,
    steps: u32,
    is_over: bool,
}

impl Highway {
    pub(crate) const ACTION_DIM: usize = 2;

    pub(crate) fn new(config: &EnvConfig, spec: EnvSpec, scene: Scene) -> Self {
        Self {
            renderer: Renderer::new(spec.image.height, scene.light),
            spec,
            scene,
            repeat_reward: config.repeat_reward,
            vehicles: config.vehicles,
            weather_drift: config.weather_drift,
            world: None,
            steps: 0,
            is_over: false,
        }
    }

    fn check_action(&self, action: &[f32]) -> Result<[f64; 2], EnvError> {
        let &[steer, pedal] = action else {
            return Err(EnvError::ActionDim {
                expected: Self::ACTION_DIM,
                actual: action.len(),
            });
        };
        if let Some(index) = action.iter().position(|value| !value.is_finite()) {
            return Err(EnvError::ActionNotFinite {
                index,
                value: action[index],
            });
        }
        Ok([steer, pedal].map(|value| f64::from(value.clamp(-1.0, 1.0))))
    }
}

impl Environment for Highway {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        let mut world = World::new(self.scene, seed, self.vehicles);
        if self.weather_drift {
            world.let_weather_drift(seed);
        }
        let world = self.world.insert(world);
        self.steps = 0;
        self.is_over = false;
        Ok(Transition::first(self.renderer.render(world)))
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        let [steer, pedal] = self.check_action(action)?;
        let world = self.world.as_mut().ok_or(EnvError::NotReset)?;
        if self.is_over {
            return Err(EnvError::EpisodeOver);
        }
        let mut sum = 0.0;
        let mut frames = 0;
        let mut interaction = false;
        let mut end_reason = None;
        while frames < self.spec.action_repeat && end_reason.is_none() {
            let frame = world.step(steer, pedal);
            sum += frame.reward;
            frames += 1;
            interaction |= frame.interaction;
            end_reason = frame.end;
        }
        world.metrics.agent_step(interaction);
        self.steps += 1;
        if self.steps >= self.spec.time_limit {
            end_reason = end_reason.or(Some(EndReason::TimeLimit));
        }
        self.is_over = end_reason.is_some();
        let is_terminal = end_reason.is_some_and(EndReason::is_terminal);
        Ok(Transition {
            image: self.renderer.render(world),
            reward: self.repeat_reward.combine(sum, frames),
            discount: if is_terminal { 0.0 } else { 1.0 },
            is_last: self.is_over,
            is_terminal,
            interaction,
            end_reason,
        })
    }

    fn segmentation(&self) -> Option<Vec<u8>> {
        self.world.as_ref().map(|_| self.renderer.segmentation())
    }

    fn metrics(&self) -> Vec<(&'static str, f64)> {
        self.world
            .as_ref()
            .map(|world| world.metrics.named())
            .unwrap_or_default()
    }

    fn privileged(&self) -> Option<PrivilegedView> {
        self.world.as_ref().map(World::privileged)
    }
}
