//! What an environment shows and takes.

use std::fmt;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Shape of an observation: height, width and channels of a `u8` image in row-major HWC order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImageShape {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Channels per pixel: 3 for RGB.
    pub channels: usize,
}

impl ImageShape {
    /// Bytes of one image.
    pub fn bytes(&self) -> usize {
        self.height * self.width * self.channels
    }
}

/// The contract of an environment. Two parties whose specs hash differently refuse each other.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EnvSpec {
    /// Stable name, for example `highway/day`.
    pub id: String,
    /// Observation.
    pub image: ImageShape,
    /// Dimensions of the action; each in `[-1, 1]`.
    pub action_dim: usize,
    /// Simulator frames per agent step.
    pub action_repeat: u32,
    /// Agent steps after which an episode is cut.
    pub time_limit: u32,
}

impl EnvSpec {
    /// Hexadecimal hash over all fields.
    pub fn hash(&self) -> String {
        let digest = Sha256::digest(self.to_string().as_bytes());
        digest[..8]
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect()
    }
}

impl fmt::Display for EnvSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} ({}x{}x{} image, {} actions, repeat {}, {} steps)",
            self.id,
            self.image.height,
            self.image.width,
            self.image.channels,
            self.action_dim,
            self.action_repeat,
            self.time_limit
        )
    }
}
