//! Which sequence is drawn next.
//!
//! A sequence is `length` contiguous steps of one episode, so its first step (or its last) names it. Selections
//! hold counts and weights of sequences only; where steps lie is the index's business.

mod episodes;
mod fifo;
mod prioritized;
mod recent;
mod run_set;
mod steps;
mod sum_tree;

use std::fmt::Debug;
use std::ops::Range;

use rand_chacha::ChaCha8Rng;

use self::sum_tree::SumTree;

/// How a table draws.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Selector {
    /// Uniform over start steps: every sequence has the same probability.
    Steps,
    /// Uniform over the episodes that hold a sequence, then over their start steps: the paper's.
    Episodes,
    /// With `probability` (0 to 1) the last sequence of an episode, all episodes alike, else as [`Self::Episodes`].
    Ends {
        /// Of a last sequence.
        probability: f64,
    },
    /// In proportion to `priority^exponent`; new sequences take the greatest priority ever set. The exponent
    /// is 0 or greater; 0 makes all that have a priority above 0 alike.
    Prioritized {
        /// Of the priorities.
        exponent: f64,
    },
    /// Each sequence once, in the order of arrival, whoever asks.
    Fifo,
    /// With `probability` (0 to 1) uniform over the `newest` (at least 1) sequences, else uniform over all.
    Recent {
        /// Sequences that count as new.
        newest: u64,
        /// Of a draw from the newest.
        probability: f64,
    },
}

impl Selector {
    /// What makes the selector unusable; none where it can be used.
    pub(crate) fn fault(&self) -> Option<&'static str> {
        match *self {
            Self::Prioritized { exponent } if !(exponent >= 0.0 && exponent.is_finite()) => {
                Some("its priority exponent must be 0 or greater")
            }
            Self::Ends { probability } if !(0.0..=1.0).contains(&probability) => {
                Some("its probability of last sequences must lie between 0 and 1")
            }
            Self::Recent { newest: 0, .. } => Some("its newest sequences must be at least 1"),
            Self::Recent { probability, .. } if !(0.0..=1.0).contains(&probability) => {
                Some("its probability of new sequences must lie between 0 and 1")
            }
            _ => None,
        }
    }
}

/// A drawn sequence and the probability of the draw.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Pick {
    pub(crate) target: Target,
    pub(crate) probability: f64,
}

/// A sequence, named in the way that the selection knows it by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Target {
    /// It starts `start` steps into a run.
    Run { run: u32, start: u32 },
    /// It ends `back` steps before the end of a chunk, 1 being the chunk's last step.
    Chunk { ordinal: u64, back: u32 },
    /// It ends with the step of that number, counted over all insertions.
    Step { number: u64 },
}

/// A chunk as selections know it: numbers count all insertions, without gaps.
#[derive(Debug, Clone)]
pub(crate) struct Span {
    /// Number of the chunk.
    pub(crate) ordinal: u64,
    /// Numbers of its steps.
    pub(crate) steps: Range<u64>,
}

/// The sequences of one table, kept up to date by the index.
pub(crate) trait Selection: Debug + Send {
    /// A run now holds `starts` sequences, 0 where it is gone.
    fn run_changed(&mut self, _run: u32, _starts: u32) {}

    /// A chunk arrived, behind all earlier ones, or changed: its last `ends` steps end sequences.
    fn chunk_changed(&mut self, _chunk: &Span, _ends: u32) {}

    /// No chunk before `ordinal` and no step before `step` is held any more.
    fn forget_before(&mut self, _ordinal: u64, _step: u64) {}

    /// Whether [`Selection::draw`] would find a sequence.
    fn can_draw(&self) -> bool;

    /// The next sequence.
    fn draw(&mut self, rng: &mut ChaCha8Rng) -> Option<Pick>;

    /// Sets the priority of the sequence that ends with step `step`. False where nothing is drawn by priority
    /// or that sequence cannot be drawn.
    fn set_priority(&mut self, _step: u64, _priority: f32) -> bool {
        false
    }
}

/// The selection that `selector` describes, without sequences yet; the first chunk and step it will hear of
/// have these numbers.
pub(crate) fn start(selector: &Selector, ordinal: u64, step: u64) -> Box<dyn Selection> {
    match *selector {
        Selector::Steps => Box::new(steps::Steps::new()),
        Selector::Episodes => Box::new(episodes::Episodes::new(0.0)),
        Selector::Ends { probability } => Box::new(episodes::Episodes::new(probability)),
        Selector::Prioritized { exponent } => {
            Box::new(prioritized::Prioritized::new(exponent, step))
        }
        Selector::Fifo => Box::new(fifo::Fifo::new(ordinal)),
        Selector::Recent {
            newest,
            probability,
        } => Box::new(recent::Recent::new(newest, probability, ordinal)),
    }
}

/// Notes in a tree with one weight per chunk that the chunk's last `ends` steps end sequences.
fn set_ends(tree: &mut SumTree, chunk: &Span, ends: u32) {
    if chunk.ordinal == tree.end() {
        tree.push(ends);
    } else {
        tree.set(chunk.ordinal, ends);
    }
}
