//! Which environments of a server are driven, and which are free.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isodream_envs::Environment;

/// An environment that one command at a time may use.
pub(super) type Shared = Arc<tokio::sync::Mutex<Box<dyn Environment>>>;

/// All environments of a server.
pub(super) struct Stock {
    free: Mutex<Vec<Shared>>,
    count: usize,
}

/// Environments that nobody else drives while this lives.
pub(super) struct Lease {
    environments: Vec<Shared>,
    stock: Arc<Stock>,
}

impl Stock {
    pub(super) fn new(environments: Vec<Box<dyn Environment>>) -> Self {
        let shared = |env| Arc::new(tokio::sync::Mutex::new(env));
        Self {
            count: environments.len(),
            free: Mutex::new(environments.into_iter().map(shared).collect()),
        }
    }

    /// How many there are, driven ones included.
    pub(super) fn len(&self) -> usize {
        self.count
    }

    /// Takes `count` environments, or says how many are free where that is less.
    pub(super) fn lease(self: &Arc<Self>, count: usize) -> Result<Lease, usize> {
        let mut free = self.free();
        let left = free.len().checked_sub(count).ok_or(free.len())?;
        Ok(Lease {
            environments: free.split_off(left),
            stock: self.clone(),
        })
    }

    fn free(&self) -> MutexGuard<'_, Vec<Shared>> {
        self.free.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Lease {
    pub(super) fn environments(&self) -> &[Shared] {
        &self.environments
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.stock.free().append(&mut self.environments);
    }
}
