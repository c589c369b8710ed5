//! Holding the ratio of sampled to inserted steps.
//!
//! With `surplus = (inserted - min_steps) * samples_per_insert - sampled`, in sampled steps, inserts wait while
//! the surplus exceeds the tolerance and samples wait while it is below its negative: never both.

/// Settings of a [`RateLimiter`].
#[derive(Debug, Clone, PartialEq)]
pub struct LimiterOptions {
    /// Steps inserted before the first sample.
    pub min_steps: u64,
    /// Steps sampled per step inserted; 0 or less removes the limit.
    pub samples_per_insert: f64,
    /// How far, in sampled steps, either side may run ahead. At least one batch (sequences x length) and one
    /// chunk (steps x `samples_per_insert`), or the two sides hand over in small turns.
    pub tolerance_steps: f64,
}

/// How a draw is accounted for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Draw {
    /// Counts, and waits for its turn.
    Limited,
    /// Pretraining: does not count, waits for `min_steps` only.
    Unlimited,
}

/// Counts of inserted and sampled steps, and who has to wait.
///
/// An operation is admitted when its side is not ahead by more than the tolerance, so that a side is ahead by
/// at most the tolerance and one operation.
#[derive(Debug, Clone)]
pub struct RateLimiter {
    options: LimiterOptions,
    inserted: u64,
    sampled: u64,
}

impl RateLimiter {
    /// A limiter of a store into which `inserted` steps went already.
    pub fn new(options: LimiterOptions, inserted: u64) -> Self {
        Self {
            options,
            inserted,
            sampled: 0,
        }
    }

    /// Steps inserted, admitted ones included.
    pub fn inserted_steps(&self) -> u64 {
        self.inserted
    }

    /// Steps sampled under the limiter.
    pub fn sampled_steps(&self) -> u64 {
        self.sampled
    }

    /// Takes over the learner's count: it alone knows what its checkpoint has seen.
    pub fn set_sampled(&mut self, steps: u64) {
        self.sampled = steps;
    }

    /// Why an insert has to wait; none where it may go on. `can_sample` tells whether any sequence could be
    /// drawn: while there is none, inserts never wait, or both sides would wait for ever.
    pub fn why_insert_waits(&self, can_sample: bool) -> Option<String> {
        let unlimited = self.options.samples_per_insert <= 0.0;
        let filling = self.inserted < self.options.min_steps || !can_sample;
        let surplus = self.surplus();
        if unlimited || filling || surplus <= self.options.tolerance_steps {
            return None;
        }
        Some(format!(
            "the learner is behind: {} steps inserted, {} sampled, {:.0} more due at {} per insert beyond the first {} (tolerance {:.0})",
            self.inserted,
            self.sampled,
            surplus,
            self.options.samples_per_insert,
            self.options.min_steps,
            self.options.tolerance_steps
        ))
    }

    /// Why a draw has to wait; none where it may go on.
    pub fn why_sample_waits(&self, draw: Draw, can_sample: bool) -> Option<String> {
        if self.inserted < self.options.min_steps {
            return Some(format!(
                "too little experience: {} of {} steps inserted",
                self.inserted, self.options.min_steps
            ));
        }
        if !can_sample {
            return Some(format!(
                "no episode is long enough for a sequence yet, or all were drawn: {} steps inserted",
                self.inserted
            ));
        }
        let surplus = self.surplus();
        let limited = draw == Draw::Limited && self.options.samples_per_insert > 0.0;
        if !limited || surplus >= -self.options.tolerance_steps {
            return None;
        }
        Some(format!(
            "the actors are behind: {} steps sampled, {} inserted, {:.0} sampled too many at {} per insert beyond the first {} (tolerance {:.0})",
            self.sampled,
            self.inserted,
            -surplus,
            self.options.samples_per_insert,
            self.options.min_steps,
            self.options.tolerance_steps
        ))
    }

    /// Counts an admitted insert.
    pub fn insert(&mut self, steps: u64) {
        self.inserted = self.inserted.saturating_add(steps);
    }

    /// Takes back an admitted insert that was not stored.
    pub fn undo_insert(&mut self, steps: u64) {
        self.inserted = self.inserted.saturating_sub(steps);
    }

    /// Counts an admitted draw.
    pub fn sample(&mut self, draw: Draw, steps: u64) {
        if draw == Draw::Limited {
            self.sampled = self.sampled.saturating_add(steps);
        }
    }

    /// Takes back an admitted draw that was not sent.
    pub fn undo_sample(&mut self, draw: Draw, steps: u64) {
        if draw == Draw::Limited {
            self.sampled = self.sampled.saturating_sub(steps);
        }
    }

    /// Sampled steps due (positive) or drawn in advance (negative).
    fn surplus(&self) -> f64 {
        let beyond = self.inserted as f64 - self.options.min_steps as f64;
        beyond * self.options.samples_per_insert - self.sampled as f64
    }
}

#[cfg(test)]
#[path = "limiter_tests.rs"]
mod tests;
