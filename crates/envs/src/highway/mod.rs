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
mod lane_change;
mod maps;
mod metrics;
mod reward;
mod road;
mod scene;
mod soak;
mod spawn;
mod traffic;
mod waves;
mod weather;
mod world;

use isodream_core::EnvSpec;
use isodream_core::config::{EnvConfig, RepeatReward};

pub(crate) use self::car::{Build, Car};
pub(crate) use self::ego::WIDTH as EGO_WIDTH;
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

use crate::environment::{EndReason, Outlook, PrivilegedView, Simulator};
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
    /// `None` where pictures have no pixels.
    renderer: Option<Renderer>,
    world: Option<World>,
    steps: u32,
    is_over: bool,
}

impl Highway {
    pub(crate) const ACTION_DIM: usize = 2;

    /// Without pictures where those of `spec` have no pixels.
    pub(crate) fn new(config: &EnvConfig, spec: EnvSpec, scene: Scene) -> Self {
        let height = spec.image.height;
        Self {
            renderer: (height > 0).then(|| Renderer::new(height, scene.light)),
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

    fn picture(&mut self) -> Vec<u8> {
        match (&mut self.renderer, &self.world) {
            (Some(renderer), Some(world)) => renderer.render(world),
            _ => Vec::new(),
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
        self.world = Some(world);
        self.steps = 0;
        self.is_over = false;
        Ok(Transition::first(self.picture()))
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        let [steer, pedal] = self.check_action(action)?;
        let world = self.world.as_mut().ok_or(EnvError::NotReset)?;
        if self.is_over {
            return Err(EnvError::EpisodeOver);
        }
        let repeated = world.repeat(steer, pedal, self.spec.action_repeat);
        world.metrics.agent_step(repeated.interaction);
        let mut end_reason = repeated.end;
        self.steps += 1;
        if self.steps >= self.spec.time_limit {
            end_reason = end_reason.or(Some(EndReason::TimeLimit));
        }
        self.is_over = end_reason.is_some();
        let is_terminal = end_reason.is_some_and(EndReason::is_terminal);
        Ok(Transition {
            image: self.picture(),
            reward: self.repeat_reward.combine(repeated.reward, repeated.frames),
            discount: if is_terminal { 0.0 } else { 1.0 },
            is_last: self.is_over,
            is_terminal,
            interaction: repeated.interaction,
            end_reason,
        })
    }

    fn segmentation(&self) -> Option<Vec<u8>> {
        self.world.as_ref()?;
        Some(self.renderer.as_ref()?.segmentation())
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

    fn simulator(&self) -> Option<Box<dyn Simulator>> {
        Some(Box::new(Future {
            world: self.world.clone()?,
            repeat_reward: self.repeat_reward,
            action_repeat: self.spec.action_repeat,
            steps_left: self.spec.time_limit.saturating_sub(self.steps),
            is_over: self.is_over,
        }))
    }
}

/// A copy of a highway's world.
#[derive(Clone)]
struct Future {
    world: World,
    repeat_reward: RepeatReward,
    action_repeat: u32,
    steps_left: u32,
    is_over: bool,
}

impl Simulator for Future {
    fn fork(&self) -> Box<dyn Simulator> {
        Box::new(self.clone())
    }

    fn privileged(&self) -> PrivilegedView {
        self.world.privileged()
    }

    fn step(&mut self, action: &[f32]) -> Outlook {
        let mut reward = 0.0;
        if let (false, &[steer, pedal]) = (self.is_over, action) {
            let [steer, pedal] = [steer, pedal].map(|value| f64::from(value.clamp(-1.0, 1.0)));
            let repeated = self.world.repeat(steer, pedal, self.action_repeat);
            reward = self
                .repeat_reward
                .combine(repeated.reward, repeated.frames)
                .into();
            self.steps_left = self.steps_left.saturating_sub(1);
            self.is_over = repeated.end.is_some() || self.steps_left == 0;
        }
        Outlook {
            reward,
            is_last: self.is_over,
        }
    }
}
