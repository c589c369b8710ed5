//! What must never go back.

use std::collections::BTreeMap;
use std::fmt;

/// Epoch and number of an actor's next chunk. Every start of an actor is a later epoch.
pub(super) type Position = (u64, u64);

/// What is durable of a run. None of it ever gets smaller.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Progress {
    /// Updates that the newest checkpoint holds.
    pub(super) updates: u64,
    /// Steps ever inserted into each replay-server's store, in the order of their folders.
    pub(super) inserted: Vec<u64>,
    /// Position of every actor, in the store where it is now.
    pub(super) actors: BTreeMap<String, Position>,
}

impl Progress {
    pub(super) fn position_of(&self, actor: &str) -> Position {
        self.actors.get(actor).copied().unwrap_or_default()
    }

    pub(super) fn steps(&self) -> u64 {
        self.inserted.iter().sum()
    }

    /// Whether nothing is less than it was.
    pub(super) fn holds(&self, earlier: &Self) -> bool {
        let mut stores = earlier.inserted.iter().enumerate();
        let mut actors = earlier.actors.iter();
        self.updates >= earlier.updates
            && stores.all(|(store, steps)| self.inserted.get(store) >= Some(steps))
            && actors.all(|(actor, position)| self.position_of(actor) >= *position)
    }
}

impl fmt::Display for Progress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            updates, inserted, ..
        } = self;
        write!(f, "checkpoint {updates}, {inserted:?} steps stored")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn progress(updates: u64, inserted: &[u64], position: Position) -> Progress {
        Progress {
            updates,
            inserted: inserted.to_vec(),
            actors: BTreeMap::from([("a".to_owned(), position)]),
        }
    }

    #[test]
    fn whatever_gets_less_is_noticed() {
        let earlier = progress(20, &[10, 30], (1, 5));
        assert!(earlier.holds(&earlier));
        // A new start of the actor counts from 0 again; a new store may appear.
        assert!(progress(21, &[11, 30, 0], (2, 0)).holds(&earlier));
        assert!(!progress(19, &[11, 31], (1, 6)).holds(&earlier));
        assert!(!progress(21, &[41, 29], (1, 6)).holds(&earlier));
        assert!(!progress(21, &[41], (1, 6)).holds(&earlier));
        assert!(!progress(21, &[11, 31], (1, 4)).holds(&earlier));
        assert!(!progress(21, &[11, 31], (0, 9)).holds(&earlier));
    }
}
