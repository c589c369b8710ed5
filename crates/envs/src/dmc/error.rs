//! What can go wrong with a control task.

use std::path::PathBuf;

/// A control task could not be loaded, started, stepped or compared.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ControlError {
    /// MuJoCo is not there, or is another version.
    #[error(
        "cannot load MuJoCo's library {file} ({reason}): run `cargo xtask setup`, or put its folder into LD_LIBRARY_PATH; \
         environments other than dmc/ work without it"
    )]
    LibraryMissing {
        /// Its file name.
        file: &'static str,
        /// The loader's words.
        reason: String,
    },
    /// A model file of the Control Suite is not there.
    #[error(
        "cannot find {}: run `cargo xtask setup`, or point {} at the suite folder of dm_control",
        path.display(),
        super::SUITE_DIR_VARIABLE
    )]
    ModelMissing {
        /// Where it was looked for.
        path: PathBuf,
    },
    /// A model file is there but is not what the task needs.
    #[error("cannot use {}: {reason}; `cargo xtask setup --verify` restores it", path.display())]
    Model {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// No random pose without contact was found to start from.
    #[error("found no pose without contact in {attempts} draws")]
    NoFreePose {
        /// Poses that were drawn.
        attempts: usize,
    },
    /// MuJoCo warned that the simulated state is no longer valid.
    #[error("simulation became invalid ({warnings}), reset the environment")]
    Unstable {
        /// MuJoCo's names of what happened, comma-separated.
        warnings: String,
    },
    /// The comparison with dm_control itself failed.
    #[error("cannot {what} (needs Python 3 with venv and pip, and once the network): {reason}")]
    Peer {
        /// What was attempted.
        what: &'static str,
        /// The end of what it said.
        reason: String,
    },
}
