//! Conversions between messages and core types, and the handshake check.

use isodream_core::{Chunk, EnvSpec};

use crate::v1;

/// Version of the protocol in `/proto`; parties of different versions refuse each other.
pub const PROTOCOL_VERSION: u32 = 1;

/// A message that cannot be a core type.
#[derive(Debug, thiserror::Error)]
#[error("invalid message: {0}")]
pub struct InvalidMessage(pub String);

/// Two parties that do not belong together, and the field that tells.
#[derive(Debug, thiserror::Error)]
pub enum Mismatch {
    /// Different protocol versions.
    #[error(
        "protocol version {theirs} does not match {ours}; run the same isodream build on both sides"
    )]
    Protocol {
        /// This side's version.
        ours: u32,
        /// The peer's version.
        theirs: u32,
    },
    /// Different environments.
    #[error(
        "environment `{theirs}` does not match `{ours}`; start both sides with the same [env] configuration"
    )]
    Environment {
        /// This side's spec in words.
        ours: String,
        /// The peer's spec in words.
        theirs: String,
    },
    /// Different model configurations.
    #[error(
        "model hash {theirs} does not match {ours}; start both sides with the same [model] configuration"
    )]
    Model {
        /// This side's hash.
        ours: String,
        /// The peer's hash.
        theirs: String,
    },
    /// The handshake is missing.
    #[error("the first message carries no handshake; connect with an isodream client")]
    Missing,
}

/// What a party says of itself in a handshake.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// `EnvSpec::hash`.
    pub env_spec_hash: String,
    /// The spec in words.
    pub env_spec: String,
    /// Hash of the model configuration; empty for a party without a model, which matches any.
    pub model_hash: String,
}

impl Identity {
    /// The identity of a party that works on `spec` with the model `model_hash` (may be empty).
    pub fn new(spec: &EnvSpec, model_hash: impl Into<String>) -> Self {
        Self {
            env_spec_hash: spec.hash(),
            env_spec: spec.to_string(),
            model_hash: model_hash.into(),
        }
    }

    /// The message that introduces this party.
    pub fn handshake(&self) -> v1::Handshake {
        v1::Handshake {
            protocol_version: PROTOCOL_VERSION,
            env_spec_hash: self.env_spec_hash.clone(),
            env_spec: self.env_spec.clone(),
            model_hash: self.model_hash.clone(),
        }
    }

    /// Accepts a peer, or names what differs.
    ///
    /// # Errors
    /// [`Mismatch`] where protocol, environment or (if both have one) model differ.
    pub fn check(&self, peer: Option<&v1::Handshake>) -> Result<(), Mismatch> {
        let peer = peer.ok_or(Mismatch::Missing)?;
        if peer.protocol_version != PROTOCOL_VERSION {
            return Err(Mismatch::Protocol {
                ours: PROTOCOL_VERSION,
                theirs: peer.protocol_version,
            });
        }
        if peer.env_spec_hash != self.env_spec_hash {
            return Err(Mismatch::Environment {
                ours: self.env_spec.clone(),
                theirs: peer.env_spec.clone(),
            });
        }
        let both_have_models = !self.model_hash.is_empty() && !peer.model_hash.is_empty();
        if both_have_models && peer.model_hash != self.model_hash {
            return Err(Mismatch::Model {
                ours: self.model_hash.clone(),
                theirs: peer.model_hash.clone(),
            });
        }
        Ok(())
    }
}

impl From<Chunk> for v1::Chunk {
    fn from(chunk: Chunk) -> Self {
        Self {
            actor_id: chunk.actor_id,
            epoch: chunk.epoch,
            seq: chunk.seq,
            episode_id: chunk.episode_id,
            first_step: chunk.first_step,
            steps: chunk.steps,
            ends_episode: chunk.ends_episode,
            payload: chunk.payload,
        }
    }
}

impl TryFrom<v1::Chunk> for Chunk {
    type Error = InvalidMessage;

    fn try_from(chunk: v1::Chunk) -> Result<Self, InvalidMessage> {
        if chunk.steps == 0 {
            return Err(InvalidMessage(format!(
                "chunk {} of {} holds no steps",
                chunk.seq, chunk.actor_id
            )));
        }
        Ok(Self {
            actor_id: chunk.actor_id,
            epoch: chunk.epoch,
            seq: chunk.seq,
            episode_id: chunk.episode_id,
            first_step: chunk.first_step,
            steps: chunk.steps,
            ends_episode: chunk.ends_episode,
            payload: chunk.payload,
        })
    }
}
