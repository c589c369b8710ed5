//! What was tried and what came of it.

use std::fmt::Write as _;

use serde::Serialize;

use crate::ledger::Audit;

/// One fault.
#[derive(Debug, Default, Serialize)]
pub(crate) struct Row {
    pub(crate) fault: String,
    /// How it was injected.
    pub(crate) how: String,
    pub(crate) tried: usize,
    /// Stores against ledgers; none where the fault is not about experience. Shared by all rows of one training.
    pub(crate) audit: Option<Audit>,
    /// From the end of each fault until updates and inserts moved again.
    pub(crate) recovery_secs: Vec<f64>,
    /// What else was measured.
    pub(crate) notes: Vec<String>,
    /// What is not as it should be.
    pub(crate) failures: Vec<String>,
}

impl Row {
    pub(crate) fn new(fault: &str, how: &str) -> Self {
        Self {
            fault: fault.into(),
            how: how.into(),
            ..Self::default()
        }
    }

    /// Adds what is wrong where `result` is.
    pub(crate) fn take<T>(&mut self, result: anyhow::Result<T>) -> Option<T> {
        match result {
            Ok(value) => Some(value),
            Err(error) => {
                self.failures.push(format!("{error:#}"));
                None
            }
        }
    }

    /// Takes a time to recover, or why there is none.
    pub(crate) fn recovered(&mut self, result: anyhow::Result<f64>) {
        if let Some(secs) = self.take(result) {
            self.recovery_secs.push(secs);
        }
    }
}

/// Median and maximum.
fn spread(values: &[f64]) -> Option<(f64, f64)> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    Some((*sorted.get(sorted.len() / 2)?, *sorted.last()?))
}

/// The rows as a table in Markdown, and below it what is wrong.
pub(crate) fn render(rows: &[Row]) -> String {
    let mut text = String::from(
        "| fault | how injected | times tried | acknowledged steps: in all / lost / altered | steps stored twice | time to recover, s: median / max |\n|---|---|---|---|---|---|\n",
    );
    for row in rows {
        let (steps, doubled) = row.audit.map_or(("-".into(), "-".into()), |audit| {
            (
                format!(
                    "{} / {} / {}",
                    audit.acknowledged_steps, audit.lost_steps, audit.altered_steps
                ),
                audit.doubled_steps.to_string(),
            )
        });
        let recovery = spread(&row.recovery_secs).map_or("-".into(), |(median, max)| {
            format!("{median:.1} / {max:.1}")
        });
        let (fault, how, tried) = (&row.fault, &row.how, row.tried);
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "| {fault} | {how} | {tried} | {steps} | {doubled} | {recovery} |"
        );
    }
    for row in rows {
        for note in &row.notes {
            let _ = writeln!(text, "\n{}: {note}", row.fault);
        }
    }
    for row in rows {
        for failure in &row.failures {
            let _ = writeln!(text, "\nFAILED {}: {failure}", row.fault);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_shows_its_numbers_and_its_failures() {
        let mut row = Row::new("kill -9 of the learner", "SIGKILL");
        row.tried = 3;
        row.audit = Some(Audit {
            acknowledged_steps: 70,
            lost_steps: 5,
            ..Audit::default()
        });
        row.recovery_secs = vec![2.0, 9.0, 1.0];
        row.recovered(Err(anyhow::anyhow!("it never came back")));
        let text = render(&[row]);
        assert!(
            text.contains("| 3 | 70 / 5 / 0 | 0 | 2.0 / 9.0 |"),
            "{text}"
        );
        assert!(text.contains("FAILED kill -9 of the learner: it never came back"));
        assert!(!render(&[Row::new("a", "b")]).contains("FAILED"));
    }
}
