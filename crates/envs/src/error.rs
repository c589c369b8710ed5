//! What can go wrong between an agent and an environment.

use std::path::PathBuf;

/// An environment could not be made, reset or stepped.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EnvError {
    /// No environment has this id.
    #[error(
        "unknown environment id \"{id}\", nearest known ids: {nearest}; `isodream env list` names all"
    )]
    UnknownId {
        /// What was asked for.
        id: String,
        /// The known ids that are nearest to it, comma-separated.
        nearest: String,
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
    /// A driver that tries out the future was given an environment that cannot be copied.
    #[error("environment \"{id}\" has no simulator, drivers cannot try out their plans in it")]
    NoSimulator {
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
    /// A video background cannot be used.
    #[error("cannot use {} as a background: {reason}; {cure}", path.display())]
    Background {
        /// The file or folder.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
        /// What to do.
        cure: &'static str,
    },
    /// An environment returned what no agent may learn from.
    #[error("environment \"{id}\" broke its contract at step {step}: {what}; the row is refused")]
    InvalidTransition {
        /// Id of the environment.
        id: String,
        /// Steps since the reset.
        step: u64,
        /// What is wrong with the row.
        what: String,
    },
    /// What was asked for needs to know which pixels are background, and the environment does not.
    #[error(
        "environment \"{id}\" does not know its background pixels, noise must have the target `image`"
    )]
    NoSegmentation {
        /// Id of the environment.
        id: String,
    },
    /// A batch of no environments.
    #[error("a batch needs at least one environment")]
    EmptyVector,
    /// A batch of environments that do not belong together.
    #[error(
        "environment {index} of the batch is {actual}, the first one is {expected}; all must be alike"
    )]
    SpecsDiffer {
        /// Index of the environment.
        index: usize,
        /// Spec of the first one.
        expected: String,
        /// Its own spec.
        actual: String,
    },
    /// The threads of a batch could not be started.
    #[error("cannot start threads for environments: {reason}; use fewer")]
    Threads {
        /// The system's words.
        reason: String,
    },
    /// One environment of a batch failed.
    #[error("environment {index} of the batch: {source}")]
    InVector {
        /// Index of the environment.
        index: usize,
        /// Its error.
        source: Box<EnvError>,
    },
    /// An environment has a defect.
    #[error("environment panicked: {message}")]
    Panicked {
        /// Its last words.
        message: String,
    },
    /// An environment in another process failed.
    #[error("remote environment {address}: {fault}")]
    Remote {
        /// Address of the process.
        address: String,
        /// What happened.
        fault: RemoteFault,
    },
}

/// What can happen to an environment in another process.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RemoteFault {
    /// Nobody answers there, or the connection broke. A reset connects again.
    #[error("connection lost: {0}; check that it still runs, a reset connects again")]
    Lost(String),
    /// It took too long.
    #[error("no answer within {0:?}; it hangs or needs a longer deadline")]
    Deadline(std::time::Duration),
    /// It will not work with this client.
    #[error("refused: {0}")]
    Refused(String),
    /// It does not keep to the protocol.
    #[error("protocol violated: {0}")]
    Protocol(String),
    /// It reports an error of its own.
    #[error("reports: {0}")]
    Failed(String),
}
