//! Episodes in the words of the protocol.

use isodream_proto::v1;

use crate::rollout::Outcome;

/// What the learner is told of an episode.
pub(crate) fn report(
    actor_id: &str,
    role: v1::ActorRole,
    policy: Option<v1::PolicyVersion>,
    episode_id: u64,
    outcome: Outcome,
) -> v1::EpisodeReport {
    v1::EpisodeReport {
        actor_id: actor_id.to_owned(),
        role: role.into(),
        policy,
        episode_id,
        score: outcome.score,
        length: outcome.length,
        end_reason: outcome
            .end_reason
            .map(|reason| reason.as_str().to_owned())
            .unwrap_or_default(),
        metrics: outcome.metrics.into_iter().collect(),
        film: None,
        probe: None,
    }
}
