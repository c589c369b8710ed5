//! Whether the metrics that the dashboard draws are those that a replay-server has.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

const DASHBOARD: &str = "deploy/compose/monitoring/grafana/dashboards/isodream.json";

/// What all names of our metrics begin with.
const PREFIX: &str = "replay_";

/// Fails where the dashboard draws something that is not in `served`, the text of a replay-server's metrics.
pub(super) fn check(root: &Path, served: &str) -> Result<()> {
    let path = root.join(DASHBOARD);
    let text =
        fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let drawn = drawn(&text).with_context(|| format!("{} is damaged", path.display()))?;
    compare(&drawn, served)
}

fn compare(drawn: &BTreeSet<String>, served: &str) -> Result<()> {
    ensure!(!drawn.is_empty(), "the dashboard draws nothing");
    let served: BTreeSet<String> = served
        .lines()
        .filter(|line| !line.starts_with('#'))
        .flat_map(names)
        .collect();
    let missing: Vec<&str> = drawn.difference(&served).map(String::as_str).collect();
    if !missing.is_empty() {
        bail!(
            "the dashboard draws what no replay-server has: {}",
            missing.join(", ")
        );
    }
    Ok(())
}

/// Names of our metrics in all expressions of a dashboard.
fn drawn(dashboard: &str) -> Result<BTreeSet<String>> {
    let dashboard: Value = serde_json::from_str(dashboard)?;
    let panels = dashboard["panels"].as_array().context("no panels")?;
    let mut found = BTreeSet::new();
    for target in panels
        .iter()
        .flat_map(|panel| panel["targets"].as_array().into_iter().flatten())
    {
        found.extend(names(
            target["expr"].as_str().context("a target without `expr`")?,
        ));
    }
    Ok(found)
}

/// The words that begin as our metrics do.
fn names(text: &str) -> impl Iterator<Item = String> {
    text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'))
        .filter(|word| word.starts_with(PREFIX))
        .map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Metrics are described where they are published, so that this finds a renamed one without a server.
    #[test]
    fn the_dashboard_draws_what_the_server_describes() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let source = root.join("crates/replay-server/src/metrics.rs");
        check(&root, &fs::read_to_string(source).unwrap()).unwrap();
    }

    #[test]
    fn an_unknown_metric_is_found() {
        let dashboard =
            r#"{"panels": [{"targets": [{"expr": "rate(replay_stepz[1m]) / replay_steps"}]}]}"#;
        let drawn = drawn(dashboard).unwrap();
        let error = compare(&drawn, "replay_steps 3\n").unwrap_err().to_string();
        assert!(error.ends_with("has: replay_stepz"), "{error}");
        compare(
            &drawn,
            "# HELP replay_steps held\nreplay_steps 3\nreplay_stepz 1\n",
        )
        .unwrap();
        // A comment alone is not a metric.
        assert!(compare(&drawn, "# TYPE replay_stepz gauge\nreplay_steps 3\n").is_err());
    }
}
