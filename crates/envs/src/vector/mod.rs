//! Many environments, stepped together.

mod pool;

use std::num::NonZeroUsize;

use isodream_core::{EnvSpec, derive_seed};

use self::pool::{Job, Order, Pool};
use crate::{EnvError, Environment, Transition};

/// A batch of environments with one spec, over a bounded number of threads.
///
/// Every environment has a seed of its own per episode, derived from the batch's seed, its index and the
/// number of its episode. The same seed and actions give the same bytes with any number of threads.
///
/// An environment whose episode ends is reset within the same step. What ended and what begins are both
/// returned, by their own names ([`VectorStep`]): no observation is hidden, no step is lost.
pub struct VectorEnvironment {
    spec: EnvSpec,
    /// `None` only while an environment is being stepped.
    members: Vec<Option<Box<dyn Environment>>>,
    /// Episodes that each member began.
    episodes: Vec<u64>,
    seed: u64,
    pool: Pool,
    is_running: bool,
}

/// What one environment of a batch answers to its action.
#[derive(Debug, Clone, PartialEq)]
pub struct VectorStep {
    /// The row that the action led to. With `is_last` it is its episode's last one, with the observation that
    /// this episode ended on.
    pub transition: Transition,
    /// With `is_last`: the episode that began after it. The next action answers to its first row.
    pub next: Option<NextEpisode>,
}

/// The episode after one that ended.
#[derive(Debug, Clone, PartialEq)]
pub struct NextEpisode {
    /// Its row 0.
    pub first: Transition,
    /// The measurements of the episode that ended, which the reset wiped.
    pub metrics: Vec<(&'static str, f64)>,
}

impl VectorEnvironment {
    /// A batch of `environments`, stepped by at most `threads` threads (the caller's one included; more than
    /// one per environment are not started).
    ///
    /// # Errors
    /// If there is no environment, if their specs differ, or if threads cannot be started.
    pub fn new(
        environments: Vec<Box<dyn Environment>>,
        seed: u64,
        threads: NonZeroUsize,
    ) -> Result<Self, EnvError> {
        let spec = common_spec(&environments)?;
        let threads = threads.get().min(environments.len());
        let pool = Pool::new(threads).map_err(|error| EnvError::Threads {
            reason: error.to_string(),
        })?;
        Ok(Self {
            spec,
            episodes: vec![0; environments.len()],
            members: environments.into_iter().map(Some).collect(),
            seed,
            pool,
            is_running: false,
        })
    }

    /// What every environment shows and takes.
    pub fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    /// How many environments.
    #[expect(clippy::len_without_is_empty, reason = "there is always one")]
    pub fn len(&self) -> usize {
        self.members.len()
    }

    /// Environment `index`, for what only a single one can be asked.
    pub fn environment(&self, index: usize) -> Option<&dyn Environment> {
        self.members.get(index)?.as_deref()
    }

    /// Begins a new episode in every environment and returns their rows 0, in order.
    ///
    /// # Errors
    /// [`EnvError::InVector`] names the first environment that failed.
    pub fn reset(&mut self) -> Result<Vec<Transition>, EnvError> {
        self.is_running = false;
        let orders = (0..self.len())
            .map(|index| Order::Reset {
                seed: self.next_seed(index),
            })
            .collect();
        for episode in &mut self.episodes {
            *episode += 1;
        }
        let steps = self.run(orders)?;
        self.is_running = true;
        Ok(steps.into_iter().map(|step| step.transition).collect())
    }

    /// Steps every environment: row `i` of `actions` `[N, A]` goes to environment `i`.
    ///
    /// # Errors
    /// [`EnvError::ActionDim`] if `actions` has another length, [`EnvError::NotReset`] before the first reset
    /// and after an error, [`EnvError::InVector`] if an environment fails: the whole batch must then be reset.
    pub fn step(&mut self, actions: &[f32]) -> Result<Vec<VectorStep>, EnvError> {
        let expected = self.len() * self.spec.action_dim;
        if actions.len() != expected {
            return Err(EnvError::ActionDim {
                expected,
                actual: actions.len(),
            });
        }
        if !std::mem::take(&mut self.is_running) {
            return Err(EnvError::NotReset);
        }
        let orders = (0..self.len())
            .zip(actions.chunks(self.spec.action_dim))
            .map(|(index, action)| Order::Step {
                action: action.to_vec(),
                seed: self.next_seed(index),
            })
            .collect();
        let steps = self.run(orders)?;
        for (episode, step) in self.episodes.iter_mut().zip(&steps) {
            *episode += u64::from(step.next.is_some());
        }
        self.is_running = true;
        Ok(steps)
    }

    fn next_seed(&self, index: usize) -> u64 {
        let episode = self.episodes[index].to_string();
        derive_seed(
            self.seed,
            &["environment", &index.to_string(), "episode", &episode],
        )
    }

    /// Carries out one order per environment.
    fn run(&mut self, orders: Vec<Order>) -> Result<Vec<VectorStep>, EnvError> {
        let members = self.members.iter_mut().zip(orders).enumerate();
        let jobs = members.filter_map(|(index, (member, order))| {
            let env = member.take()?;
            Some(Job { index, env, order })
        });
        let mut finished = self.pool.run(jobs.collect());
        finished.sort_by_key(|done| done.index);
        let mut steps = Vec::with_capacity(finished.len());
        for done in finished {
            self.members[done.index] = Some(done.env);
            steps.push(done.outcome.map_err(|source| EnvError::InVector {
                index: done.index,
                source: Box::new(source),
            }));
        }
        steps
            .into_iter()
            .map(|step| step.map(|(transition, next)| VectorStep { transition, next }))
            .collect()
    }
}

/// The spec of environments that are to be driven together.
///
/// # Errors
/// If there is no environment, or if their specs differ.
pub fn common_spec(environments: &[Box<dyn Environment>]) -> Result<EnvSpec, EnvError> {
    let spec = environments.first().ok_or(EnvError::EmptyVector)?.spec();
    for (index, env) in environments.iter().enumerate() {
        if env.spec() != spec {
            return Err(EnvError::SpecsDiffer {
                index,
                expected: spec.to_string(),
                actual: env.spec().to_string(),
            });
        }
    }
    Ok(spec.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{Fault, Script};

    fn batch(threads: usize, environments: Vec<Script>) -> VectorEnvironment {
        let environments = environments.into_iter().map(Script::boxed).collect();
        VectorEnvironment::new(environments, 11, NonZeroUsize::new(threads).unwrap()).unwrap()
    }

    #[test]
    fn the_end_and_the_next_beginning_are_both_returned() {
        let mut batch = batch(2, vec![Script::of_length(2), Script::of_length(3)]);
        let first = batch.reset().unwrap();
        assert_ne!(first[0].image, first[1].image, "both got the same seed");
        let steps = batch.step(&[0.1, 0.2]).unwrap();
        assert!(
            steps
                .iter()
                .all(|step| step.next.is_none() && !step.transition.is_last)
        );

        let steps = batch.step(&[0.1, 0.2]).unwrap();
        assert!(steps[0].transition.is_last && steps[1].next.is_none());
        let next = steps[0].next.as_ref().unwrap();
        assert_eq!(next.metrics, [("steps", 2.0)]);
        assert_eq!(next.first.reward, 0.0);
        assert_ne!(next.first.image, first[0].image, "the episode was repeated");

        let steps = batch.step(&[0.3, 0.2]).unwrap();
        assert!(!steps[0].transition.is_last && steps[1].transition.is_last);
        assert_eq!(batch.environment(0).unwrap().metrics(), [("steps", 1.0)]);
    }

    #[test]
    fn any_number_of_threads_gives_the_same() {
        let run = |threads| {
            let scripts = (0..7).map(|index| Script::of_length(3 + index)).collect();
            let mut batch = batch(threads, scripts);
            let mut rows = vec![format!("{:?}", batch.reset().unwrap())];
            for step in 0..25 {
                let actions: Vec<f32> = (0..7).map(|index| (index * step) as f32 / 200.0).collect();
                rows.push(format!("{:?}", batch.step(&actions).unwrap()));
            }
            rows
        };
        let alone = run(1);
        for threads in [2, 3, 16] {
            assert_eq!(run(threads), alone, "{threads} threads");
        }
    }

    #[test]
    fn failures_name_the_environment_and_end_with_a_reset() {
        for (fault, words) in [
            (Fault::Error, "scripted"),
            (Fault::Panic, "panicked: as scripted"),
        ] {
            let scripts = vec![Script::of_length(9), Script::of_length(9).with(fault, 2)];
            let mut batch = batch(2, scripts);
            batch.reset().unwrap();
            batch.step(&[0.0, 0.0]).unwrap();
            let error = batch.step(&[0.0, 0.0]).unwrap_err();
            assert!(
                matches!(error, EnvError::InVector { index: 1, .. }),
                "{error}"
            );
            assert!(error.to_string().contains(words), "{error}");
            assert_eq!(batch.step(&[0.0, 0.0]), Err(EnvError::NotReset));
            batch.reset().unwrap();
            batch.step(&[0.0, 0.0]).unwrap();
        }
    }

    #[test]
    fn batches_that_make_no_sense_are_refused() {
        let one = NonZeroUsize::MIN;
        assert!(matches!(
            VectorEnvironment::new(Vec::new(), 0, one),
            Err(EnvError::EmptyVector)
        ));
        let mut other = Script::of_length(2);
        other.spec.time_limit += 1;
        let differing = vec![Script::of_length(2).boxed(), other.boxed()];
        let error = VectorEnvironment::new(differing, 0, one).err().unwrap();
        assert!(matches!(error, EnvError::SpecsDiffer { index: 1, .. }));

        let mut batch = batch(1, vec![Script::of_length(2), Script::of_length(2)]);
        assert_eq!(batch.step(&[0.0, 0.0]), Err(EnvError::NotReset));
        batch.reset().unwrap();
        let error = batch.step(&[0.0]).unwrap_err();
        assert_eq!(
            error,
            EnvError::ActionDim {
                expected: 2,
                actual: 1
            }
        );
    }
}
