//! What a monitoring system sees of a replay-server, by the `metrics` facade: nothing where nobody installed a recorder.

use std::sync::Arc;
use std::time::Duration;

use isodream_proto::v1::ReplayStatus;
use metrics::{counter, describe_counter, describe_gauge, describe_histogram, gauge, histogram};
use tokio_util::sync::CancellationToken;

use crate::state::State;

/// How often counts and gauges are renewed.
const INTERVAL: Duration = Duration::from_secs(1);

/// Renews counts and gauges until `stop`.
pub(crate) fn start(state: Arc<State>, stop: CancellationToken) {
    describe();
    tokio::spawn(async move {
        let mut ticks = tokio::time::interval(INTERVAL);
        loop {
            tokio::select! {
                _ = ticks.tick() => publish(&state.status()),
                () = stop.cancelled() => return,
            }
        }
    });
}

/// A group of chunks was written and synced.
pub(crate) fn committed(chunks: usize, bytes: usize, took: Duration) {
    histogram!("replay_commit_seconds").record(took);
    histogram!("replay_commit_chunks").record(chunks as f64);
    counter!("replay_committed_bytes_total").increment(bytes as u64);
}

fn describe() {
    describe_gauge!("replay_steps", "steps held");
    describe_gauge!("replay_episodes", "episodes held");
    describe_gauge!("replay_bytes", "bytes of the records held");
    describe_gauge!("replay_insert_waiting", "1 while inserts wait");
    describe_gauge!("replay_sample_waiting", "1 while draws wait");
    describe_counter!(
        "replay_inserted_steps_total",
        "steps inserted since the store was made"
    );
    describe_counter!(
        "replay_sampled_steps_total",
        "steps drawn under the limiter"
    );
    describe_counter!("replay_quarantined_records_total", "damaged stretches met");
    describe_counter!("replay_committed_bytes_total", "payload bytes made durable");
    describe_histogram!("replay_commit_seconds", "writing and syncing one group");
    describe_histogram!("replay_commit_chunks", "chunks of one group");
}

fn publish(status: &ReplayStatus) {
    let waiting = |why: &String| f64::from(u8::from(!why.is_empty()));
    gauge!("replay_steps").set(status.steps as f64);
    gauge!("replay_episodes").set(status.episodes as f64);
    gauge!("replay_bytes").set(status.bytes as f64);
    gauge!("replay_insert_waiting").set(waiting(&status.insert_waiting));
    gauge!("replay_sample_waiting").set(waiting(&status.sample_waiting));
    counter!("replay_inserted_steps_total").absolute(status.inserted_steps);
    counter!("replay_sampled_steps_total").absolute(status.sampled_steps);
    counter!("replay_quarantined_records_total").absolute(status.quarantined_records);
}
