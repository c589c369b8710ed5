//! How often replay-servers make experience durable, as their metrics tell.

use std::time::Duration;

use anyhow::Context;
use serde::Serialize;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

/// How long metrics may take.
const DEADLINE: Duration = Duration::from_secs(10);

/// What every replay-server's metrics have from its start.
const SERVER_METRIC: &str = "replay_inserted_steps_total";

/// Groups of chunks that were written and synced since a server started.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Commits {
    count: f64,
    seconds: f64,
    chunks: f64,
}

/// The commits of all servers over the time of the measurement.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub(super) struct CommitLoad {
    /// Each is one fdatasync.
    pub(super) per_s: f64,
    pub(super) chunks_each: f64,
    pub(super) ms_each: f64,
}

impl Commits {
    const NONE: Self = Self {
        count: 0.0,
        seconds: 0.0,
        chunks: 0.0,
    };

    /// Asks the metrics at `address`.
    pub(super) async fn read(address: &str) -> anyhow::Result<Self> {
        let asking = async {
            let mut connection = TcpStream::connect(address).await?;
            let request =
                format!("GET /metrics HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
            connection.write_all(request.as_bytes()).await?;
            let mut answer = String::new();
            connection.read_to_string(&mut answer).await?;
            anyhow::Ok(answer)
        };
        let answer = tokio::time::timeout(DEADLINE, asking)
            .await
            .with_context(|| format!("no metrics came from {address} within {DEADLINE:?}"))??;
        Self::parse(&answer)
    }

    fn parse(text: &str) -> anyhow::Result<Self> {
        // A server that has committed nothing yet has its other metrics alone.
        if !text.contains("replay_commit_") && text.contains(SERVER_METRIC) {
            return Ok(Self::NONE);
        }
        let value = |name: &str| -> anyhow::Result<f64> {
            let value = text
                .lines()
                .find_map(|line| line.strip_prefix(name)?.strip_prefix(' '))
                .with_context(|| format!("the replay-server's metrics have no {name}"))?;
            Ok(value.trim().parse()?)
        };
        Ok(Self {
            count: value("replay_commit_seconds_count")?,
            seconds: value("replay_commit_seconds_sum")?,
            chunks: value("replay_commit_chunks_sum")?,
        })
    }
}

impl CommitLoad {
    /// Between the first and the second of each pair.
    pub(super) fn between(pairs: impl Iterator<Item = (Commits, Commits)>, seconds: f64) -> Self {
        let sum = pairs.fold(Commits::NONE, |sum, (before, after)| Commits {
            count: sum.count + after.count - before.count,
            seconds: sum.seconds + after.seconds - before.seconds,
            chunks: sum.chunks + after.chunks - before.chunks,
        });
        let each = sum.count.max(1.0);
        Self {
            per_s: sum.count / seconds,
            chunks_each: sum.chunks / each,
            ms_each: 1e3 * sum.seconds / each,
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn commits_are_read_from_metrics_and_a_missing_one_is_named() {
        let text = "HTTP/1.1 200 OK\r\n\r\n# TYPE replay_commit_seconds summary\n\
                    replay_commit_seconds{quantile=\"0.5\"} 9\nreplay_commit_seconds_sum 0.5\n\
                    replay_commit_seconds_count 20\nreplay_commit_chunks_sum 60\n";
        let read = Commits::parse(text).unwrap();
        let later = Commits {
            count: 30.0,
            seconds: 0.6,
            chunks: 80.0,
        };
        let load = CommitLoad::between([(read, later)].into_iter(), 2.0);
        assert_eq!((load.per_s, load.chunks_each), (5.0, 2.0));
        assert!((load.ms_each - 10.0).abs() < 1e-9, "{load:?}");
        let idle = Commits::parse("replay_inserted_steps_total 0\n").unwrap();
        assert_eq!((idle.count, idle.seconds, idle.chunks), (0.0, 0.0, 0.0));
        Commits::parse("HTTP/1.1 404 Not Found\r\n").unwrap_err();
        let error = Commits::parse(&text.replace("chunks_sum", "x")).unwrap_err();
        assert!(error.to_string().contains("replay_commit_chunks_sum"));
    }
}
