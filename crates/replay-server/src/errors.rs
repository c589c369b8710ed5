//! Store errors as services answer them.

use isodream_replay::ReplayError;
use isodream_rpc::ServiceError;

pub(crate) fn service_error(error: &ReplayError) -> ServiceError {
    let words = error.to_string();
    match error {
        ReplayError::Fenced { .. } => ServiceError::Refused(words),
        ReplayError::InvalidChunk { .. }
        | ReplayError::InvalidTable { .. }
        | ReplayError::InvalidPriority { .. }
        | ReplayError::NoPriorities { .. } => ServiceError::Invalid(words),
        ReplayError::Full { .. } => ServiceError::Exhausted(words),
        ReplayError::Sync { .. } | ReplayError::Stopped { .. } => ServiceError::Unavailable(words),
        _ => ServiceError::Internal(words),
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    #[test]
    fn a_full_disk_may_be_tried_again_and_a_fence_may_not() {
        let full = ReplayError::Full {
            path: PathBuf::from("segment"),
        };
        assert!(
            matches!(service_error(&full), ServiceError::Exhausted(words) if words.contains("free space"))
        );
        assert!(!full.is_fatal());
        let fenced = ReplayError::Fenced {
            actor_id: "actor-0".into(),
            epoch: 1,
            newer: 2,
        };
        assert!(matches!(service_error(&fenced), ServiceError::Refused(_)));
    }
}
