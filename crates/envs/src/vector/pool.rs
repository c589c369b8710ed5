//! Threads that step environments.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender, unbounded};

use super::NextEpisode;
use crate::{EnvError, Environment, Transition};

/// An environment on its way to whoever steps it.
pub(super) struct Job {
    pub(super) index: usize,
    pub(super) env: Box<dyn Environment>,
    pub(super) order: Order,
}

/// What to do with an environment.
pub(super) enum Order {
    Reset {
        seed: u64,
    },
    /// `seed` is that of the next episode.
    Step {
        action: Vec<f32>,
        seed: u64,
    },
}

/// An environment on its way back.
pub(super) struct Done {
    pub(super) index: usize,
    pub(super) env: Box<dyn Environment>,
    pub(super) outcome: Result<(Transition, Option<NextEpisode>), EnvError>,
}

/// Persistent threads beside the caller's, which works as well. A step takes 0.1 to 1 ms, of which starting
/// threads anew each time would take a good part; environments travel as pointers, to whoever is free.
pub(super) struct Pool {
    jobs: Option<Sender<Job>>,
    queue: Receiver<Job>,
    done: (Sender<Done>, Receiver<Done>),
    workers: Vec<JoinHandle<()>>,
}

impl Pool {
    /// A pool of `threads` threads, the caller's one counted.
    pub(super) fn new(threads: usize) -> std::io::Result<Self> {
        let (jobs, queue) = unbounded();
        let done = unbounded();
        let spawn = |number: usize| {
            let (queue, done): (Receiver<Job>, Sender<Done>) = (queue.clone(), done.0.clone());
            std::thread::Builder::new()
                .name(format!("env-{number}"))
                .spawn(move || {
                    while let Ok(job) = queue.recv() {
                        if done.send(work(job)).is_err() {
                            return;
                        }
                    }
                })
        };
        let workers = (1..threads).map(spawn).collect::<std::io::Result<_>>()?;
        Ok(Self {
            jobs: Some(jobs),
            queue,
            done,
            workers,
        })
    }

    /// Does all jobs and returns them in no particular order.
    pub(super) fn run(&self, jobs: Vec<Job>) -> Vec<Done> {
        let count = jobs.len();
        let Some(sender) = &self.jobs else {
            return Vec::new();
        };
        // Both channels live as long as the pool: nothing can be lost.
        for job in jobs {
            let _ = sender.send(job);
        }
        let mut finished = Vec::with_capacity(count);
        while let Ok(job) = self.queue.try_recv() {
            finished.push(work(job));
        }
        while finished.len() < count
            && let Ok(done) = self.done.1.recv()
        {
            finished.push(done);
        }
        finished
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.jobs = None;
        for worker in self.workers.drain(..) {
            // It has nothing to say: panics of environments are caught where they happen.
            let _ = worker.join();
        }
    }
}

fn work(mut job: Job) -> Done {
    let outcome = catch_unwind(AssertUnwindSafe(|| obey(job.env.as_mut(), &job.order)));
    let outcome = outcome.unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let message = text.or_else(|| panic.downcast_ref::<&str>().copied());
        Err(EnvError::Panicked {
            message: message.unwrap_or("without words").to_owned(),
        })
    });
    Done {
        index: job.index,
        env: job.env,
        outcome,
    }
}

fn obey(
    env: &mut dyn Environment,
    order: &Order,
) -> Result<(Transition, Option<NextEpisode>), EnvError> {
    match order {
        Order::Reset { seed } => Ok((env.reset(*seed)?, None)),
        Order::Step { action, seed } => {
            let transition = env.step(action)?;
            if !transition.is_last {
                return Ok((transition, None));
            }
            let metrics = env.metrics();
            let next = NextEpisode {
                first: env.reset(*seed)?,
                metrics,
            };
            Ok((transition, Some(next)))
        }
    }
}
