//! What ledger actors were told is durable, against what the stores hold.
//!
//! A ledger is a text file with a line per acknowledged chunk: store, episode, first step, steps and checksum of the
//! payload. A line is written with one call before the client drops the chunk, so that an actor that is killed at any
//! moment leaves whole lines, but for the last one at most.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use isodream_core::{Chunk, EpisodeId};
use isodream_replay::for_each_chunk;
use isodream_rpc::AcknowledgedChunks;

/// A stretch of an episode in a store.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Entry {
    pub(crate) store_id: String,
    pub(crate) episode_id: EpisodeId,
    pub(crate) first_step: u32,
    pub(crate) steps: u32,
    /// CRC-32C of the payload.
    pub(crate) checksum: u32,
}

impl Entry {
    fn new(store_id: &str, chunk: &Chunk) -> Self {
        Self {
            store_id: store_id.to_owned(),
            episode_id: chunk.episode_id,
            first_step: chunk.first_step,
            steps: chunk.steps,
            checksum: crc32c::crc32c(&chunk.payload),
        }
    }

    fn line(&self) -> String {
        let (store, steps) = (&self.store_id, self.steps);
        let (episode, first, checksum) = (self.episode_id, self.first_step, self.checksum);
        format!("{store} {episode} {first} {steps} {checksum}\n")
    }

    fn parse(line: &str) -> Option<Self> {
        let mut words = line.split(' ');
        let entry = Self {
            store_id: words.next()?.to_owned(),
            episode_id: words.next()?.parse().ok()?,
            first_step: words.next()?.parse().ok()?,
            steps: words.next()?.parse().ok()?,
            checksum: words.next()?.parse().ok()?,
        };
        words.next().is_none().then_some(entry)
    }
}

/// A file that grows by a line for each acknowledged chunk.
#[derive(Debug)]
pub(crate) struct LedgerFile {
    path: PathBuf,
    file: File,
}

impl LedgerFile {
    /// Goes on with the file at `path`, or begins it.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let file = OpenOptions::new().create(true).append(true).open(path);
        Ok(Self {
            path: path.to_owned(),
            file: file.with_context(|| format!("cannot open {}", path.display()))?,
        })
    }
}

impl AcknowledgedChunks for LedgerFile {
    fn acknowledged(&self, store_id: &str, chunk: &Chunk) {
        let line = Entry::new(store_id, chunk).line();
        // A ledger with a hole would hide a loss.
        if let Err(error) = (&self.file).write_all(line.as_bytes()) {
            eprintln!("cannot write to {}: {error}", self.path.display());
            std::process::abort();
        }
    }
}

/// Reads a ledger. What follows the last line break is a line that its writer did not live to finish.
pub(crate) fn read(path: &Path) -> Result<Vec<Entry>> {
    let text =
        fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let whole = text
        .rfind('\n')
        .map_or("", |end| text.get(..end).unwrap_or(""));
    let lines = whole.lines().enumerate();
    lines
        .map(|(number, line)| {
            Entry::parse(line)
                .with_context(|| format!("line {} of {} is damaged", number + 1, path.display()))
        })
        .collect()
}

/// What the stores hold, as far as it can be compared.
#[derive(Debug, Default)]
pub(crate) struct Stored {
    entries: Vec<Entry>,
    /// Sequence numbers by store, actor and epoch.
    numbers: BTreeMap<(String, String, u64), Vec<u64>>,
}

impl Stored {
    pub(crate) fn add(&mut self, store_id: &str, chunk: &Chunk) {
        self.entries.push(Entry::new(store_id, chunk));
        let sender = (store_id.to_owned(), chunk.actor_id.clone(), chunk.epoch);
        self.numbers.entry(sender).or_default().push(chunk.seq);
    }

    /// Adds everything in `folder`, whose server must have stopped; `check` sees each chunk.
    pub(crate) fn read(
        &mut self,
        folder: &Path,
        mut check: impl FnMut(&Chunk) -> Result<()>,
    ) -> Result<()> {
        let path = folder.join("ID");
        let id =
            fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let report = isodream_replay::verify(folder)?;
        if let Some(damage) = report.damage.first() {
            bail!("{} is damaged: {damage:?}", folder.display());
        }
        for_each_chunk(folder, |chunk| {
            self.add(id.trim_end(), &chunk);
            check(&chunk)
        })
    }
}

/// How ledgers and stores agree.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub(crate) struct Audit {
    /// Steps in the ledgers.
    pub(crate) acknowledged_steps: u64,
    /// Those among them that the store that acknowledged them does not hold.
    pub(crate) lost_steps: u64,
    /// Those that it holds with another content or length.
    pub(crate) altered_steps: u64,
    /// Steps that all stores together hold more than once, from any actor.
    pub(crate) doubled_steps: u64,
    /// Chunks that are missing between others of the same actor, epoch and store.
    pub(crate) missing_chunks: u64,
    /// Steps that the stores hold, from any actor.
    pub(crate) stored_steps: u64,
}

impl Audit {
    /// Compares `acknowledged` with `stored`.
    pub(crate) fn of(acknowledged: &[Entry], stored: &Stored) -> Self {
        let mut audit = Self::default();
        let held: BTreeMap<_, _> = stored
            .entries
            .iter()
            .map(|entry| ((&entry.store_id, entry.episode_id, entry.first_step), entry))
            .collect();
        for entry in acknowledged {
            let steps = u64::from(entry.steps);
            audit.acknowledged_steps += steps;
            match held.get(&(&entry.store_id, entry.episode_id, entry.first_step)) {
                None => audit.lost_steps += steps,
                Some(found) if *found != entry => audit.altered_steps += steps,
                Some(_) => {}
            }
        }
        let mut stretches: Vec<_> = stored
            .entries
            .iter()
            .map(|entry| {
                (
                    entry.episode_id,
                    entry.first_step,
                    entry.first_step + entry.steps,
                )
            })
            .collect();
        stretches.sort_unstable();
        let (mut episode, mut covered) = (None, 0);
        for (episode_id, first, end) in stretches {
            audit.stored_steps += u64::from(end - first);
            if episode != Some(episode_id) {
                (episode, covered) = (Some(episode_id), 0);
            }
            audit.doubled_steps += u64::from(covered.min(end).saturating_sub(first));
            covered = covered.max(end);
        }
        for numbers in stored.numbers.values() {
            let mut sorted = numbers.clone();
            sorted.sort_unstable();
            audit.missing_chunks += sorted
                .windows(2)
                .map(|pair| (pair[1] - pair[0]).saturating_sub(1))
                .sum::<u64>();
        }
        audit
    }

    /// Whether nothing was lost, altered or stored twice.
    pub(crate) fn is_clean(&self) -> bool {
        (
            self.lost_steps,
            self.altered_steps,
            self.doubled_steps,
            self.missing_chunks,
        ) == (0, 0, 0, 0)
    }
}

#[cfg(test)]
#[path = "ledger_tests.rs"]
mod tests;
