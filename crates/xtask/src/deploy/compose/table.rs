//! What was done, how long it took, and what the run had before and afterwards.

use std::time::Instant;

use super::watch::Progress;

/// A row for everything that was done.
#[derive(Debug, Default)]
pub(super) struct Table(Vec<Row>);

#[derive(Debug)]
struct Row {
    what: String,
    seconds: f64,
    before: Option<Progress>,
    after: Progress,
}

impl Table {
    /// Just now the run, which was at `before` or did not exist, has reached `after`.
    pub(super) fn add(
        &mut self,
        what: &str,
        begun: Instant,
        before: Option<Progress>,
        after: Progress,
    ) {
        self.0.push(Row {
            what: what.to_owned(),
            seconds: begun.elapsed().as_secs_f64(),
            before,
            after,
        });
    }

    pub(super) fn print(&self) {
        eprintln!(
            "{:<32} {:>7}  {:>18}  {:>18}",
            "done", "seconds", "steps acknowledged", "updates"
        );
        for row in &self.0 {
            let from = |count: fn(&Progress) -> u64| row.before.as_ref().map_or(0, count);
            let steps = format!("{} to {}", from(|p| p.inserted), row.after.inserted);
            let updates = format!("{} to {}", from(|p| p.updates), row.after.updates);
            eprintln!(
                "{:<32} {:>7.1}  {steps:>18}  {updates:>18}",
                row.what, row.seconds
            );
        }
    }
}
