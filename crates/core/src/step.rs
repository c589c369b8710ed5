//! Steps, as environments make them and replay stores them.

use bytes::Bytes;

/// Identifies an episode in a store: derived from what an actor drew at its start and a counter, so that no coordination is needed.
pub type EpisodeId = u64;

/// Row `t` of an episode: an observation and what led to it.
///
/// Row 0 is the reset: `action` is zero, `reward` is 0 and `discount` is 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// Observation `o_t`: `[H, W, C]` bytes.
    pub image: Vec<u8>,
    /// The action that led to `o_t` (the paper's `a_{t-1}`), each dimension in `[-1, 1]`.
    pub action: Vec<f32>,
    /// The reward received on arriving at `o_t`.
    pub reward: f32,
    /// 0 where the episode really ended, else 1 (also at a time limit).
    pub discount: f32,
    /// Whether this is row 0.
    pub is_first: bool,
    /// Whether this is the episode's last row.
    pub is_last: bool,
    /// Whether the episode ended for a reason inside the environment, not for a time limit.
    pub is_terminal: bool,
}

/// Consecutive rows of one episode, column by column.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Steps {
    /// Rows held.
    pub len: usize,
    /// Bytes of one image.
    pub image_bytes: usize,
    /// Action dimensions.
    pub action_dim: usize,
    /// `[len, H, W, C]` bytes.
    pub images: Vec<u8>,
    /// `[len, action_dim]`.
    pub actions: Vec<f32>,
    /// `[len]`.
    pub rewards: Vec<f32>,
    /// `[len]`.
    pub discounts: Vec<f32>,
    /// `[len]`: bit 0 `is_first`, bit 1 `is_last`, bit 2 `is_terminal`.
    pub flags: Vec<u8>,
}

impl Steps {
    /// An empty column store for images of `image_bytes` and actions of `action_dim`.
    pub fn new(image_bytes: usize, action_dim: usize) -> Self {
        Self {
            image_bytes,
            action_dim,
            ..Self::default()
        }
    }

    /// Appends one row.
    ///
    /// # Panics
    /// If image or action have other sizes than this store was made for: a defect of the caller.
    pub fn push(&mut self, step: &Step) {
        assert_eq!(step.image.len(), self.image_bytes, "image size");
        assert_eq!(step.action.len(), self.action_dim, "action dimensions");
        self.len += 1;
        self.images.extend_from_slice(&step.image);
        self.actions.extend_from_slice(&step.action);
        self.rewards.push(step.reward);
        self.discounts.push(step.discount);
        self.flags.push(
            u8::from(step.is_first) | u8::from(step.is_last) << 1 | u8::from(step.is_terminal) << 2,
        );
    }

    /// Appends the rows `range` of `other`.
    ///
    /// # Panics
    /// If `other` has other image or action sizes, or fewer rows: a defect of the caller.
    pub fn extend(&mut self, other: &Self, range: std::ops::Range<usize>) {
        assert_eq!(other.image_bytes, self.image_bytes, "image size");
        assert_eq!(other.action_dim, self.action_dim, "action dimensions");
        let (start, end) = (range.start, range.end);
        self.len += end - start;
        self.images
            .extend_from_slice(&other.images[start * self.image_bytes..end * self.image_bytes]);
        self.actions
            .extend_from_slice(&other.actions[start * self.action_dim..end * self.action_dim]);
        self.rewards.extend_from_slice(&other.rewards[start..end]);
        self.discounts
            .extend_from_slice(&other.discounts[start..end]);
        self.flags.extend_from_slice(&other.flags[start..end]);
    }
}

/// A stored run of consecutive steps of one episode, compressed by the actor and decoded by the learner.
///
/// `(actor_id, epoch, seq)` identifies it: sent twice, stored once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Chunk {
    /// Who collected it.
    pub actor_id: String,
    /// Grows with every start of the actor; handed out by the first store that it reaches.
    pub epoch: u64,
    /// Counts the chunks of one epoch from 0 without gaps.
    pub seq: u64,
    /// The episode it belongs to.
    pub episode_id: EpisodeId,
    /// Index within the episode of its first step.
    pub first_step: u32,
    /// Steps it holds, at least 1.
    pub steps: u32,
    /// Whether it holds the episode's last step.
    pub ends_episode: bool,
    /// [`crate::codec`]: the steps, encoded.
    pub payload: Bytes,
}
