//! The way of a number from the replay-server's metrics through the rules of prometheus-adapter to the autoscaler.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result};
use serde_json::Value;

use super::objects::{Objects, list, text, title};

/// Where the adapter's rules are, in `deploy/k8s`.
pub(super) const RULES: &str = "monitoring/adapter-rules.yaml";

/// Names of the metrics that a replay-server exports.
pub(super) fn exported(root: &Path) -> Result<Vec<String>> {
    let path = root.join("crates/replay-server/src/metrics.rs");
    let source =
        fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
    Ok(gauges(&source))
}

/// The gauges that are set in `source`.
fn gauges(source: &str) -> Vec<String> {
    source
        .split("gauge!(\"")
        .skip(1)
        .filter_map(|rest| rest.split_once('"'))
        .filter(|(_, after)| after.starts_with(").set("))
        .map(|(name, _)| name.to_owned())
        .collect()
}

/// Metrics that autoscalers ask for and no rule makes, and series that rules read and nobody exports.
pub(super) fn problems(objects: Objects<'_>, rules: &Value, exported: &[String]) -> Vec<String> {
    let mut found = Vec::new();
    let rules = list(&rules["externalRules"]);
    for scaler in objects.of_kind("HorizontalPodAutoscaler") {
        let mut asked = 0;
        for metric in list(&scaler["spec"]["metrics"]) {
            let wanted = text(&metric["external"]["metric"]["name"]);
            asked += 1;
            if !rules.iter().any(|rule| rule["name"]["as"] == wanted) {
                found.push(format!("{}: no rule makes `{wanted}`", title(scaler)));
            }
        }
        if asked == 0 {
            found.push(format!("{}: asks for no metric", title(scaler)));
        }
    }
    for rule in rules {
        let query = format!(
            "{} {}",
            text(&rule["seriesQuery"]),
            text(&rule["metricsQuery"])
        );
        let mut series = query
            .split(|c: char| !c.is_ascii_alphanumeric() && c != '_')
            .filter(|word| word.starts_with("replay_"))
            .peekable();
        if series.peek().is_none() {
            found.push(format!("{RULES}: {} reads no series", rule["name"]["as"]));
        }
        for series in series.filter(|series| !exported.iter().any(|name| name == series)) {
            found.push(format!("{RULES}: no replay-server exports `{series}`"));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gauge_counts_where_it_is_set() {
        let source = r#"describe_gauge!("described", "words"); gauge!("set").set(1.0); counter!("other").absolute(1);"#;
        assert_eq!(gauges(source), ["set"]);
    }
}
