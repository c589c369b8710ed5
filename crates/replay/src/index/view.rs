//! A table at one sequence length.

use std::sync::Arc;

use super::chunks::Chunks;
use super::run::{Run, Runs};
use crate::Table;
use crate::selector::{self, Selection};

/// Names a view, and keeps it while it is held.
#[derive(Debug, Clone)]
pub struct ViewHandle {
    pub(super) id: u64,
    pub(super) length: u32,
    _user: Arc<()>,
}

impl ViewHandle {
    /// Steps per sequence.
    pub fn sequence_length(&self) -> u32 {
        self.length
    }
}

/// The sequences of `length` steps that a table draws from.
#[derive(Debug)]
pub(super) struct View {
    pub(super) id: u64,
    pub(super) table: Table,
    pub(super) length: u32,
    pub(super) selection: Box<dyn Selection>,
    users: Arc<()>,
}

impl View {
    /// A view of what is held. Takes time in proportion to it.
    pub(super) fn new(id: u64, table: Table, length: u32, chunks: &Chunks, runs: &Runs) -> Self {
        let (ordinal, number) = chunks.front();
        let mut view = Self {
            id,
            selection: selector::start(&table.selector, ordinal, number),
            table,
            length,
            users: Arc::new(()),
        };
        for ordinal in chunks.ordinals() {
            let run = chunks.get(ordinal).run().and_then(|run| runs.get(run));
            view.chunk_changed(ordinal, run, chunks);
        }
        for (id, run) in runs.iter() {
            view.run_changed(id, run.len);
        }
        view
    }

    pub(super) fn handle(&self) -> ViewHandle {
        ViewHandle {
            id: self.id,
            length: self.length,
            _user: self.users.clone(),
        }
    }

    pub(super) fn is_used(&self) -> bool {
        Arc::strong_count(&self.users) > 1
    }

    /// A chunk is new, or its run (none where it went) is another than before.
    pub(super) fn chunk_changed(&mut self, ordinal: u64, run: Option<&Run>, chunks: &Chunks) {
        let chunk = &chunks.get(ordinal).chunk;
        let ends = run.map_or(0, |run| {
            let steps_to_end = chunk.first_step - run.first_step + chunk.steps;
            steps_to_end
                .saturating_sub(self.length - 1)
                .min(chunk.steps)
        });
        self.selection.chunk_changed(&chunks.span(ordinal), ends);
    }

    /// A run has `len` steps, 0 where it went.
    pub(super) fn run_changed(&mut self, run: u32, len: u32) {
        self.selection
            .run_changed(run, len.saturating_sub(self.length - 1));
    }
}
