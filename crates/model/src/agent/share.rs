//! One thread's share of an update: the gradients of some of a batch's sequences.

use std::sync::mpsc::{Receiver, Sender, channel};

use isodream_core::Config;
use tch::{Device, Tensor};

use super::Metric;
use super::networks::Networks;
use crate::batch::Batch;
use crate::behavior::Replayed;
use crate::chunked::add_gradients;
use crate::laps::{Laps, phase};
use crate::noise::seeded;

/// What is to be computed for some sequences.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) phase: Phase,
    /// How many of the batch's sequences they are: their part in every mean.
    pub(super) weight: f64,
    /// What random numbers follow from.
    pub(super) seed: u64,
}

/// What an update consists of.
#[derive(Debug)]
pub(super) enum Phase {
    /// Representation learning. The posterior states are kept for the next job.
    World(Batch),
    /// Behaviour learning from those states, returns divided by the scale.
    Behavior(Option<Tensor>),
}

/// A job's part of the gradients, one list per optimiser with one tensor per parameter, and of the metrics.
#[derive(Debug, Default)]
pub(super) struct Answer {
    pub(super) gradients: Vec<Vec<Tensor>>,
    pub(super) metrics: Vec<Metric>,
}

impl Answer {
    /// Adds the answer for other sequences.
    pub(super) fn add(&mut self, other: Self) {
        for (sum, part) in self.gradients.iter_mut().zip(other.gradients) {
            add_gradients(sum, part);
        }
        add_metrics(&mut self.metrics, other.metrics, 1.0);
    }
}

/// Adds `weight` times the metrics of another part of the batch.
pub(super) fn add_metrics(sums: &mut Vec<Metric>, part: Vec<Metric>, weight: f64) {
    for (index, (name, value)) in part.into_iter().enumerate() {
        let value = value.detach() * weight;
        match sums.get_mut(index) {
            Some((_, sum)) => *sum += value,
            None => sums.push((name, value)),
        }
    }
}

/// Networks, and the states that one thread's sequences came to.
#[derive(Debug)]
pub(super) struct Share {
    pub(super) networks: Networks,
    replayed: Option<Replayed>,
}

impl Share {
    pub(super) fn new(networks: Networks) -> Self {
        Self {
            networks,
            replayed: None,
        }
    }

    pub(super) fn work(&mut self, job: Job, laps: &mut Laps) -> Answer {
        let device = self.networks.params.world.device();
        seeded(job.seed, device, || match job.phase {
            Phase::World(batch) => self.world(&batch, job.weight, laps),
            Phase::Behavior(return_scale) => {
                let replayed = self.replayed.take();
                let replayed = replayed.expect("world-model learning comes first");
                self.networks
                    .behavior_gradients(&replayed, return_scale.as_ref(), job.weight, laps)
            }
        })
    }

    fn world(&mut self, batch: &Batch, weight: f64, laps: &mut Laps) -> Answer {
        let networks = &self.networks;
        let loss = networks.world.loss(batch, laps);
        let params = networks.params.world.tensors();
        let gradients = Tensor::run_backward(&[loss.total * weight], &params, false, false);
        laps.lap(phase::WORLD_MODEL_BACKWARD);
        self.replayed = Some(Replayed {
            states: loss.states,
            rewards: batch.rewards.shallow_clone(),
            discounts: batch.discounts.shallow_clone(),
        });
        let mut metrics = Vec::new();
        add_metrics(&mut metrics, loss.terms, weight);
        Answer {
            gradients: vec![gradients],
            metrics,
        }
    }
}

/// A thread with a [`Share`] of its own over the weights of another.
#[derive(Debug)]
pub(super) struct Worker {
    jobs: Sender<Job>,
    answers: Receiver<Answer>,
}

impl Worker {
    /// Starts the thread, which ends with this value.
    pub(super) fn start(networks: &Networks, config: &Config, action_dim: i64) -> Self {
        let (jobs, todo) = channel::<Job>();
        let (done, answers) = channel();
        let (memory, config) = (networks.memory(), config.clone());
        std::thread::Builder::new()
            .name("update".into())
            .spawn(move || {
                let networks = Networks::over(memory, &config, action_dim, Device::Cpu);
                let mut share = Share::new(networks);
                while let Ok(job) = todo.recv() {
                    if done.send(share.work(job, &mut Laps::off())).is_err() {
                        return;
                    }
                }
            })
            .expect("the system starts a thread");
        Self { jobs, answers }
    }

    pub(super) fn begin(&self, job: Job) {
        self.jobs.send(job).expect("a worker outlives its jobs");
    }

    pub(super) fn finish(&self) -> Answer {
        self.answers.recv().expect("a worker answers its jobs")
    }
}
