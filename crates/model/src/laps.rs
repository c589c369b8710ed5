//! Where the time of a training step goes: wall and CPU seconds by phase.

use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};
use tch::Device;

/// The phases of a training step.
pub mod phase {
    /// Encoder and latent dynamics, forward.
    pub const ENCODE: &str = "encode and observe";
    /// Decoders and image loss, forward and, but for what is shared by all frames, backward.
    pub const DECODE: &str = "decode";
    /// The other losses, forward, hypothetical transitions included.
    pub const LOSSES: &str = "losses";
    /// The rest of the world model's backward pass, and its optimiser.
    pub const WORLD_MODEL_BACKWARD: &str = "world model backward";
    /// Imagined trajectories, with the actor's choices and rewards.
    pub const IMAGINE: &str = "imagine";
    /// Critic and slow critic, forward.
    pub const VALUES: &str = "values";
    /// Through the trajectories to the actor, and its optimiser.
    pub const ACTOR_BACKWARD: &str = "actor backward";
    /// To critic and attention, and their optimiser.
    pub const CRITIC_BACKWARD: &str = "critic backward";
}

/// Time spent in one phase.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Lap {
    /// Wall-clock seconds.
    pub wall: f64,
    /// CPU seconds of all threads of this process.
    pub cpu: f64,
}

/// A stopwatch over the phases of training steps. Training itself uses one that is off, which costs nothing.
#[derive(Debug)]
pub struct Laps {
    since: Option<(Instant, Duration)>,
    device: Device,
    laps: Vec<(&'static str, Lap)>,
}

impl Laps {
    /// A stopwatch that measures nothing.
    pub fn off() -> Self {
        Self {
            since: None,
            device: Device::Cpu,
            laps: Vec::new(),
        }
    }

    /// A stopwatch that starts now. On a GPU every lap waits for the device, so that work is charged to the
    /// phase that asked for it.
    pub fn start(device: Device) -> Self {
        let mut laps = Self {
            since: None,
            device,
            laps: Vec::new(),
        };
        laps.since = Some(laps.now());
        laps
    }

    /// Ends the phase `name`; phases of one name add up.
    pub fn lap(&mut self, name: &'static str) {
        let Some((wall, cpu)) = self.since else {
            return;
        };
        let (wall_now, cpu_now) = self.now();
        let lap = Lap {
            wall: (wall_now - wall).as_secs_f64(),
            cpu: (cpu_now - cpu).as_secs_f64(),
        };
        match self.laps.iter_mut().find(|(known, _)| *known == name) {
            Some((_, sum)) => {
                sum.wall += lap.wall;
                sum.cpu += lap.cpu;
            }
            None => self.laps.push((name, lap)),
        }
        self.since = Some((wall_now, cpu_now));
    }

    /// Phases in the order in which they first ended.
    pub fn phases(&self) -> &[(&'static str, Lap)] {
        &self.laps
    }

    fn now(&self) -> (Instant, Duration) {
        if let Device::Cuda(index) = self.device {
            tch::Cuda::synchronize(index as i64);
        }
        (Instant::now(), cpu_time())
    }
}

/// CPU time of all threads of this process so far.
pub fn cpu_time() -> Duration {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn laps_of_one_name_add_up_and_off_measures_nothing() {
        let mut off = Laps::off();
        off.lap("a");
        assert!(off.phases().is_empty());

        let mut laps = Laps::start(Device::Cpu);
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_millis(5) {
            std::hint::spin_loop();
        }
        laps.lap("a");
        laps.lap("b");
        laps.lap("a");
        let names: Vec<_> = laps.phases().iter().map(|(name, _)| *name).collect();
        assert_eq!(names, ["a", "b"]);
        let a = laps.phases()[0].1;
        assert!(a.wall >= 0.005 && a.cpu > 0.0, "{a:?}");
    }
}
