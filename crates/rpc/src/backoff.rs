//! Retries.

use std::time::Duration;

use backon::{BackoffBuilder, ExponentialBuilder, Retryable};
use tonic::Status;

use crate::is_refusal;
use crate::limits::RECONNECT_DELAYS;

/// Pauses between attempts to reconnect: growing, with jitter, without end.
pub fn reconnect_delays() -> impl Iterator<Item = Duration> + Send {
    delays(RECONNECT_DELAYS)
}

/// Pauses that grow from the first to the longest, with jitter, without end.
pub(crate) fn delays(limits: (Duration, Duration)) -> impl Iterator<Item = Duration> + Send {
    builder(limits).without_max_times().build()
}

/// Calls `operation` until it succeeds, is refused for good or failed `attempts` times.
///
/// # Errors
/// The last status.
pub async fn retry<T, F, Fut>(attempts: usize, operation: F) -> Result<T, Status>
where
    F: FnMut() -> Fut,
    Fut: Future<Output = Result<T, Status>>,
{
    operation
        .retry(builder(RECONNECT_DELAYS).with_max_times(attempts.saturating_sub(1)))
        .when(|status| !is_refusal(status))
        .await
}

fn builder((first, longest): (Duration, Duration)) -> ExponentialBuilder {
    ExponentialBuilder::default()
        .with_min_delay(first)
        .with_max_delay(longest)
        .with_jitter()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_grow_to_their_cap_and_never_end() {
        let (first, longest) = RECONNECT_DELAYS;
        let delays: Vec<_> = reconnect_delays().take(50).collect();
        assert_eq!(delays.len(), 50);
        assert!(delays[0] < first * 3, "{delays:?}");
        assert!(
            delays[49] >= longest && delays[49] <= longest * 2,
            "{delays:?}"
        );
    }

    #[tokio::test(start_paused = true)]
    async fn a_refusal_is_not_tried_again() {
        let mut calls = 0;
        let result: Result<(), _> = retry(5, || {
            calls += 1;
            async { Err(Status::failed_precondition("other environment")) }
        })
        .await;
        assert!(result.is_err());
        assert_eq!(calls, 1);
    }

    #[tokio::test(start_paused = true)]
    async fn an_outage_is_tried_again_as_often_as_asked() {
        let mut calls = 0;
        let result: Result<(), _> = retry(5, || {
            calls += 1;
            async { Err(Status::unavailable("restarting")) }
        })
        .await;
        assert!(result.is_err());
        assert_eq!(calls, 5);
    }
}
