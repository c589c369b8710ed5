//! What a replay-server may keep must fit its volume.

use serde_json::Value;
use toml::Table;

use super::objects::{Objects, list, text, title};

/// Share of a volume that the log may take: file systems keep some for themselves, and space is freed in whole segments.
const USABLE: f64 = 0.9;

/// Replay-servers that would fill their volumes.
pub(super) fn problems(objects: Objects<'_>) -> Vec<String> {
    let mut found = Vec::new();
    for workload in objects.workloads() {
        for claim in list(&workload.0["spec"]["volumeClaimTemplates"]) {
            let size = text(&claim["spec"]["resources"]["requests"]["storage"]);
            let volume = bytes(size).unwrap_or_default();
            let capacity = capacity_mb(objects).unwrap_or_default() as f64 * 1e6;
            if capacity <= 0.0 || capacity > volume * USABLE {
                found.push(format!(
                    "{}: replay.capacity_mb in run.toml must be over 0 and at most {} for a volume of {size}",
                    title(workload.0),
                    (volume * USABLE / 1e6) as u64
                ));
            }
        }
    }
    found
}

fn capacity_mb(objects: Objects<'_>) -> Option<i64> {
    let map = objects
        .of_kind("ConfigMap")
        .find(|map| map["data"]["run.toml"] != Value::Null)?;
    let settings: Table = text(&map["data"]["run.toml"]).parse().ok()?;
    settings.get("replay")?.get("capacity_mb")?.as_integer()
}

/// A quantity as these files have it.
fn bytes(quantity: &str) -> Option<f64> {
    let (number, unit) = quantity.split_at(quantity.find(|c: char| c.is_ascii_alphabetic())?);
    let power = ["Ki", "Mi", "Gi", "Ti"]
        .iter()
        .position(|known| *known == unit)?
        + 1;
    Some(number.parse::<f64>().ok()? * 1024_f64.powi(i32::try_from(power).ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantities_are_bytes() {
        assert_eq!(bytes("20Gi"), Some(21_474_836_480.0));
        assert_eq!(bytes("5"), None);
        assert_eq!(bytes("5Xi"), None);
    }
}
