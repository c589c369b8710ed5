//! What can go wrong between an agent and an environment.

/// An environment could not be made, reset or stepped.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EnvError {
    /// No environment has this id.
    #[error("unknown environment id \"{id}\", known ids: {known}")]
    UnknownId {
        /// What was asked for.
        id: String,
        /// The known ids, comma-separated.
        known: String,
    },
    /// A field of the configuration holds a value no environment can be made from.
    #[error("invalid environment config: {field} is {value}, must be {expected}")]
    InvalidConfig {
        /// The field.
        field: &'static str,
        /// Its value.
        value: String,
        /// What is allowed.
        expected: &'static str,
    },
    /// The action has another dimension than the spec says.
    #[error("action has {actual} dimensions, expected {expected}")]
    ActionDim {
        /// Dimensions of the spec.
        expected: usize,
        /// Dimensions received.
        actual: usize,
    },
    /// A component of the action is NaN or infinite.
    #[error("action[{index}] is {value}, must be finite")]
    ActionNotFinite {
        /// Index of the component.
        index: usize,
        /// Its value.
        value: f32,
    },
    /// The environment was stepped before its first reset.
    #[error("environment was stepped before its first reset")]
    NotReset,
    /// The environment was stepped after the last row of an episode.
    #[error("episode is over, reset the environment before the next step")]
    EpisodeOver,
    /// A scripted driver was given an environment that shows no privileged view.
    #[error("environment \"{id}\" has no privileged view, scripted drivers cannot drive it")]
    NoPrivilegedView {
        /// Id of the environment.
        id: String,
    },
    /// No scripted driver has this name.
    #[error("unknown driver \"{name}\", known drivers: {known}")]
    UnknownDriver {
        /// What was asked for.
        name: String,
        /// The known names, comma-separated.
        known: String,
    },
    /// A DeepMind Control task failed.
    #[cfg(feature = "mujoco")]
    #[error(transparent)]
    Control(#[from] crate::dmc::ControlError),
}
