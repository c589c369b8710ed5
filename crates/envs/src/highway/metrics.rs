//! What an episode was like so far, in numbers.

use crate::highway::collision::Impulses;
use crate::highway::ego::DT;

/// A new collision is counted after so many frames without contact.
const APART_FRAMES: u32 = 10;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Metrics {
    frames: u32,
    distance_m: f64,
    impulse_ns: f64,
    agent_steps: u32,
    /// Agent steps in which the ego touched anything.
    contact_steps: u32,
    touched: bool,
    vehicle_contacts: Contacts,
    barrier_contacts: Contacts,
    lane: usize,
    lane_changes: u32,
    interactions: u32,
    interacting: bool,
}

/// Counts contacts, where frames in close succession are one.
#[derive(Debug, Clone, Default, PartialEq)]
struct Contacts {
    count: u32,
    merged_for_frames: u32,
}

impl Contacts {
    fn frame(&mut self, touching: bool) {
        if !touching {
            self.merged_for_frames = self.merged_for_frames.saturating_sub(1);
            return;
        }
        if self.merged_for_frames == 0 {
            self.count += 1;
        }
        self.merged_for_frames = APART_FRAMES;
    }
}

impl Metrics {
    pub(crate) fn new(lane: usize) -> Self {
        Self {
            frames: 0,
            distance_m: 0.0,
            impulse_ns: 0.0,
            agent_steps: 0,
            contact_steps: 0,
            touched: false,
            vehicle_contacts: Contacts::default(),
            barrier_contacts: Contacts::default(),
            lane,
            lane_changes: 0,
            interactions: 0,
            interacting: false,
        }
    }

    pub(crate) fn frame(&mut self, distance_m: f64, lane: usize, impulses: Impulses) {
        self.frames += 1;
        self.distance_m += distance_m;
        self.impulse_ns += impulses.vehicles + impulses.barriers;
        self.touched |= impulses.vehicles + impulses.barriers > 0.0;
        self.vehicle_contacts.frame(impulses.vehicles > 0.0);
        self.barrier_contacts.frame(impulses.barriers > 0.0);
        if lane != self.lane {
            self.lane = lane;
            self.lane_changes += 1;
        }
    }

    /// Ends an agent step and tells whether it held an interaction; consecutive ones are one.
    pub(crate) fn agent_step(&mut self, interaction: bool) {
        self.agent_steps += 1;
        self.contact_steps += u32::from(self.touched);
        self.touched = false;
        if interaction && !self.interacting {
            self.interactions += 1;
        }
        self.interacting = interaction;
    }

    fn contact_share(&self) -> f64 {
        f64::from(self.contact_steps) / f64::from(self.agent_steps.max(1))
    }

    pub(crate) fn named(&self) -> Vec<(&'static str, f64)> {
        let seconds = f64::from(self.frames.max(1)) * DT;
        vec![
            ("distance_m", self.distance_m),
            ("mean_speed_m_s", self.distance_m / seconds),
            ("contact_share", self.contact_share()),
            ("collisions", f64::from(self.vehicle_contacts.count)),
            ("barrier_hits", f64::from(self.barrier_contacts.count)),
            ("impulse_ns", self.impulse_ns),
            ("lane_changes", f64::from(self.lane_changes)),
            ("interactions", f64::from(self.interactions)),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contacts_in_close_succession_are_one() {
        let mut metrics = Metrics::new(0);
        let hit = Impulses {
            vehicles: 100.0,
            barriers: 0.0,
        };
        for gap in [0, 3, 20] {
            for _ in 0..gap {
                metrics.frame(0.5, 0, Impulses::default());
            }
            metrics.frame(0.5, 0, hit);
        }
        assert!(metrics.named().contains(&("collisions", 2.0)));
        assert!(metrics.named().contains(&("impulse_ns", 300.0)));
    }

    #[test]
    fn a_step_with_contact_in_any_frame_is_one_in_contact() {
        let mut metrics = Metrics::new(0);
        for step in 0..4 {
            for frame in 0..4 {
                let vehicles = if step == 1 && frame < 2 { 50.0 } else { 0.0 };
                let impulses = Impulses {
                    vehicles,
                    barriers: 0.0,
                };
                metrics.frame(0.5, 0, impulses);
            }
            metrics.agent_step(false);
        }
        assert!(metrics.named().contains(&("contact_share", 0.25)));
    }

    #[test]
    fn consecutive_interactions_are_one() {
        let mut metrics = Metrics::new(0);
        for interaction in [true, true, false, true] {
            metrics.agent_step(interaction);
        }
        assert!(metrics.named().contains(&("interactions", 2.0)));
    }
}
