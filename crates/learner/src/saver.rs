//! Checkpoints written beside training: hashing and syncing hundreds of megabytes takes seconds.

use std::path::PathBuf;
use std::thread::JoinHandle;

use anyhow::{Context, anyhow};

use crate::checkpoint::Checkpoint;

/// Writes one checkpoint at a time in a thread of its own.
#[derive(Debug)]
pub(crate) struct Saver {
    dir: PathBuf,
    keep: usize,
    writing: Option<JoinHandle<anyhow::Result<PathBuf>>>,
}

impl Saver {
    /// A saver into `dir`, which keeps the newest `keep` checkpoints.
    pub(crate) fn new(dir: PathBuf, keep: usize) -> Self {
        Self {
            dir,
            keep,
            writing: None,
        }
    }

    /// Begins to write `checkpoint`, after the one before it is durable.
    ///
    /// # Errors
    /// Where the one before could not be written.
    pub(crate) fn save(&mut self, checkpoint: Checkpoint) -> anyhow::Result<()> {
        self.finish()?;
        let (dir, keep) = (self.dir.clone(), self.keep);
        let writing = std::thread::Builder::new()
            .name("saver".into())
            .spawn(move || {
                let updates = checkpoint.counters.updates;
                let _write = tracing::debug_span!("write_checkpoint", updates).entered();
                checkpoint.save(&dir, keep)
            })
            .context("cannot start the saver thread")?;
        self.writing = Some(writing);
        Ok(())
    }

    /// Looks whether the checkpoint in work is done, without waiting.
    ///
    /// # Errors
    /// Where it could not be written: training must not go on for long without one.
    pub(crate) fn poll(&mut self) -> anyhow::Result<()> {
        if self.writing.as_ref().is_some_and(JoinHandle::is_finished) {
            self.finish()?;
        }
        Ok(())
    }

    /// Waits until everything handed over is durable.
    ///
    /// # Errors
    /// Where the disk failed; the folders of earlier checkpoints are whole then.
    pub(crate) fn finish(&mut self) -> anyhow::Result<()> {
        let Some(writing) = self.writing.take() else {
            return Ok(());
        };
        let folder = writing
            .join()
            .map_err(|_| anyhow!("the saver thread died"))??;
        tracing::info!(folder = %folder.display(), "checkpoint");
        Ok(())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::time::{Duration, Instant};

    use isodream_core::Config;

    use super::*;
    use crate::checkpoint::Counters;

    fn checkpoint(updates: u64) -> Checkpoint {
        Checkpoint {
            counters: Counters {
                updates,
                ..Counters::default()
            },
            env_spec: "test".into(),
            config: Config::default(),
            model: vec![7; 1 << 20],
            optimizer: vec![1; 50],
        }
    }

    #[test]
    fn what_is_handed_over_is_durable_after_finish() {
        let dir = tempfile::tempdir().unwrap();
        let mut saver = Saver::new(dir.path().to_owned(), 3);
        saver.finish().unwrap();
        for updates in [1, 2] {
            saver.save(checkpoint(updates)).unwrap();
        }
        saver.finish().unwrap();
        let newest = Checkpoint::load_newest(dir.path()).unwrap().unwrap();
        assert_eq!(newest.counters.updates, 2);
        assert_eq!(newest.model, checkpoint(2).model);
    }

    #[test]
    fn a_failed_write_is_heard_without_waiting_for_the_next() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        std::fs::write(&file, b"not a folder").unwrap();
        let mut saver = Saver::new(file.join("checkpoints"), 3);
        saver.save(checkpoint(1)).unwrap();
        let begun = Instant::now();
        let error = loop {
            assert!(begun.elapsed() < Duration::from_secs(30), "no error came");
            if let Err(error) = saver.poll() {
                break error.to_string();
            }
        };
        assert!(error.contains("cannot create"), "{error}");
        saver.finish().unwrap();
    }
}
