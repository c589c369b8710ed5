//! Exactly once: which chunk every actor has to send next.

use std::collections::BTreeMap;

use isodream_core::Chunk;
use serde::Serialize;

use crate::ReplayError;

/// An actor's position.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Progress {
    /// The actor.
    pub actor_id: String,
    /// Its newest epoch; older ones are fenced off.
    pub epoch: u64,
    /// The next sequence number of that epoch.
    pub next_seq: u64,
}

/// What became of a chunk.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// It is durable.
    Stored {
        /// The next sequence number that is expected.
        next_seq: u64,
    },
    /// It was durable already and is not stored again.
    Duplicate {
        /// The next sequence number that is expected.
        next_seq: u64,
    },
    /// Chunks before it are missing; it is not stored.
    Gap {
        /// The sequence number that has to come first.
        expected_seq: u64,
    },
    /// A newer epoch of the actor exists; it is not stored.
    Fenced {
        /// The newest epoch.
        newer_epoch: u64,
    },
    /// It breaks a limit of the store; it is not stored.
    Invalid {
        /// Names the chunk and the limit.
        reason: String,
    },
}

/// Positions of all actors: epoch and next sequence number.
#[derive(Debug, Clone, Default)]
pub(crate) struct Ledger {
    positions: BTreeMap<String, (u64, u64)>,
    /// Positions before the changes that are not durable yet, the newest change last.
    undo: Vec<(String, Option<(u64, u64)>)>,
    /// The process that each actor's newest epoch was handed out to, as far as it happened since the store was opened.
    processes: BTreeMap<String, (u64, u64)>,
}

impl Ledger {
    /// Judges `chunk` and advances over it where it has to be stored.
    pub(crate) fn admit(&mut self, chunk: &Chunk) -> Outcome {
        let known = self.positions.get(&chunk.actor_id).copied();
        let expected_seq = match known {
            Some((epoch, _)) if chunk.epoch < epoch => {
                return Outcome::Fenced { newer_epoch: epoch };
            }
            Some((epoch, next_seq)) if chunk.epoch == epoch => next_seq,
            _ => 0,
        };
        if chunk.seq < expected_seq {
            return Outcome::Duplicate {
                next_seq: expected_seq,
            };
        }
        if chunk.seq > expected_seq {
            return Outcome::Gap { expected_seq };
        }
        let next_seq = expected_seq + 1;
        self.set(&chunk.actor_id, (chunk.epoch, next_seq));
        Outcome::Stored { next_seq }
    }

    /// The epoch of a process that has `claimed`, or 0 for none: then `at_least`, or more where the actor had that
    /// already. A process whose epoch of this store was lost on its way gets the same again, also where another store
    /// gave it an older one meanwhile.
    pub(crate) fn epoch_for(
        &mut self,
        actor_id: &str,
        process: u64,
        claimed: u64,
        at_least: u64,
    ) -> u64 {
        let newest = self.positions.get(actor_id).map(|(epoch, _)| *epoch);
        if let Some((known, epoch)) = self.processes.get(actor_id)
            && *known == process
            && process != 0
            && Some(*epoch) == newest
            && claimed <= *epoch
        {
            return *epoch;
        }
        if claimed != 0 {
            return claimed;
        }
        let epoch = newest.map_or(at_least, |newest| at_least.max(newest.saturating_add(1)));
        self.processes.insert(actor_id.to_owned(), (process, epoch));
        epoch
    }

    /// An actor's start or reconnection. Returns its position and whether that is news worth writing down.
    ///
    /// `acknowledged_seq` is what the actor was promised: where the store lost the record (quarantine,
    /// reset) the actor no longer has the chunk either, so the store moves on with it.
    pub(crate) fn begin(
        &mut self,
        actor_id: &str,
        epoch: u64,
        acknowledged_seq: u64,
    ) -> Result<(u64, bool), ReplayError> {
        let known = self.positions.get(actor_id).copied();
        if let Some((newer, _)) = known.filter(|(known, _)| epoch < *known) {
            return Err(ReplayError::Fenced {
                actor_id: actor_id.to_owned(),
                epoch,
                newer,
            });
        }
        let stored_seq = known
            .filter(|(known, _)| epoch == *known)
            .map(|(_, seq)| seq);
        let next_seq = stored_seq.unwrap_or(0).max(acknowledged_seq);
        self.set(actor_id, (epoch, next_seq));
        Ok((next_seq, stored_seq != Some(next_seq)))
    }

    fn set(&mut self, actor_id: &str, position: (u64, u64)) {
        let before = self.positions.insert(actor_id.to_owned(), position);
        self.undo.push((actor_id.to_owned(), before));
    }

    /// All changes are durable.
    pub(crate) fn keep(&mut self) {
        self.undo.clear();
    }

    /// Takes back all changes that are not durable.
    pub(crate) fn roll_back(&mut self) {
        while let Some((actor_id, before)) = self.undo.pop() {
            match before {
                Some(position) => self.positions.insert(actor_id, position),
                None => self.positions.remove(&actor_id),
            };
        }
    }

    /// Takes over a stored position; positions never move backwards.
    pub(crate) fn recover(&mut self, actor_id: &str, epoch: u64, next_seq: u64) {
        match self.positions.get_mut(actor_id) {
            Some(position) => *position = (*position).max((epoch, next_seq)),
            None => {
                self.positions
                    .insert(actor_id.to_owned(), (epoch, next_seq));
            }
        }
    }

    /// All positions without the changes that are not durable.
    pub(crate) fn durable_progress(&self) -> Vec<Progress> {
        let mut before = self.clone();
        before.roll_back();
        before.progress()
    }

    pub(crate) fn progress(&self) -> Vec<Progress> {
        self.positions
            .iter()
            .map(|(actor_id, &(epoch, next_seq))| Progress {
                actor_id: actor_id.clone(),
                epoch,
                next_seq,
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chunk(actor_id: &str, seq: u64) -> Chunk {
        Chunk {
            actor_id: actor_id.into(),
            epoch: 1,
            seq,
            episode_id: 0,
            first_step: 0,
            steps: 1,
            ends_episode: false,
            payload: Vec::new().into(),
        }
    }

    #[test]
    fn what_did_not_become_durable_is_taken_back() {
        let mut ledger = Ledger::default();
        ledger.admit(&chunk("a", 0));
        ledger.keep();
        let durable = ledger.progress();
        for changed in [chunk("a", 1), chunk("b", 0), chunk("a", 2)] {
            assert!(matches!(ledger.admit(&changed), Outcome::Stored { .. }));
        }
        ledger.begin("a", 4, 0).unwrap();
        assert_eq!(ledger.durable_progress(), durable);
        assert_eq!(ledger.progress().len(), 2, "asking changes nothing");
        ledger.roll_back();
        assert_eq!(ledger.progress(), durable);
        assert_eq!(
            ledger.admit(&chunk("a", 1)),
            Outcome::Stored { next_seq: 2 }
        );
    }
}
