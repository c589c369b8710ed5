//! Between messages and the types of `isodream-envs`.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

use isodream_core::{EnvSpec, ImageShape};
use isodream_envs::{EndReason, Environment, Transition};
use isodream_proto::InvalidMessage;
use isodream_proto::v1::{EnvironmentMetric, EnvironmentRow, EnvironmentSpec};

use crate::limits::MAX_MESSAGE_BYTES;

/// More metrics than this are not kept, nor longer names.
const MAX_METRICS: usize = 64;
const MAX_NAME_BYTES: usize = 64;
/// Names of metrics over the life of the process.
const MAX_NAMES: usize = 1024;
/// Far beyond any body that has been built.
const MAX_ACTION_DIM: u32 = 1024;

/// The message of a spec.
pub(super) fn spec_message(spec: &EnvSpec) -> EnvironmentSpec {
    EnvironmentSpec {
        id: spec.id.clone(),
        height: spec.image.height as u32,
        width: spec.image.width as u32,
        channels: spec.image.channels as u32,
        action_dim: spec.action_dim as u32,
        action_repeat: spec.action_repeat,
        time_limit: spec.time_limit,
    }
}

/// The spec of a message, if an environment can have it.
pub(super) fn spec(message: &EnvironmentSpec) -> Result<EnvSpec, InvalidMessage> {
    let bytes = [message.height, message.width, message.channels]
        .iter()
        .try_fold(1_usize, |bytes, &side| bytes.checked_mul(side as usize));
    // A row also carries classes and metrics: half a message is for the image.
    if !bytes.is_some_and(|bytes| (1..=MAX_MESSAGE_BYTES / 2).contains(&bytes)) {
        return Err(InvalidMessage(format!(
            "an image of {}x{}x{} is not possible",
            message.height, message.width, message.channels
        )));
    }
    for (name, value, most) in [
        ("action_dim", message.action_dim, MAX_ACTION_DIM),
        ("action_repeat", message.action_repeat, u32::MAX),
        ("time_limit", message.time_limit, u32::MAX),
    ] {
        if !(1..=most).contains(&value) {
            return Err(InvalidMessage(format!(
                "{name} is {value}, must be 1 to {most}"
            )));
        }
    }
    Ok(EnvSpec {
        id: message.id.clone(),
        image: ImageShape {
            height: message.height as usize,
            width: message.width as usize,
            channels: message.channels as usize,
        },
        action_dim: message.action_dim as usize,
        action_repeat: message.action_repeat,
        time_limit: message.time_limit,
    })
}

/// The message of a row that `env` just returned.
pub(super) fn row_message(
    row: Transition,
    env: &dyn Environment,
    segmentation: bool,
) -> EnvironmentRow {
    let classes = segmentation.then(|| env.segmentation()).flatten();
    let metrics = env
        .metrics()
        .into_iter()
        .map(|(name, value)| EnvironmentMetric {
            name: name.to_owned(),
            value,
        });
    EnvironmentRow {
        image: row.image.into(),
        reward: row.reward,
        discount: row.discount,
        is_last: row.is_last,
        is_terminal: row.is_terminal,
        interaction: row.interaction,
        end_reason: row
            .end_reason
            .map(|reason| reason.to_string())
            .unwrap_or_default(),
        segmentation: classes.unwrap_or_default().into(),
        metrics: metrics.collect(),
    }
}

/// The row of a message, unchecked.
pub(super) fn row(message: &EnvironmentRow) -> Transition {
    let reason = || EndReason::named(&message.end_reason, message.is_terminal);
    Transition {
        image: message.image.to_vec(),
        reward: message.reward,
        discount: message.discount,
        is_last: message.is_last,
        is_terminal: message.is_terminal,
        interaction: message.interaction,
        end_reason: message.is_last.then(reason),
    }
}

/// The metrics of a message, as far as they are finite and their names can be kept.
pub(super) fn metrics(message: &EnvironmentRow) -> Vec<(&'static str, f64)> {
    let metrics = message.metrics.iter().take(MAX_METRICS);
    metrics
        .filter(|metric| metric.value.is_finite())
        .filter_map(|metric| Some((kept(&metric.name)?, metric.value)))
        .collect()
}

/// `name` for the life of the process: environments name their metrics by static strings. Every name is kept
/// once, and their number is bounded, so that no peer can fill the memory.
fn kept(name: &str) -> Option<&'static str> {
    static NAMES: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
    let mut names = NAMES.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(known) = names.get(name) {
        return Some(known);
    }
    if name.is_empty() || name.len() > MAX_NAME_BYTES || names.len() >= MAX_NAMES {
        return None;
    }
    let name: &'static str = Box::leak(name.into());
    names.insert(name);
    Some(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message() -> EnvironmentSpec {
        EnvironmentSpec {
            id: "dmc/walker_walk".into(),
            height: 64,
            width: 48,
            channels: 3,
            action_dim: 6,
            action_repeat: 2,
            time_limit: 500,
        }
    }

    #[test]
    fn a_spec_survives_its_message() {
        assert_eq!(spec_message(&spec(&message()).unwrap()), message());
    }

    #[test]
    fn impossible_specs_are_refused() {
        let broken: [fn(&mut EnvironmentSpec); 6] = [
            |spec| spec.height = 0,
            |spec| spec.width = u32::MAX,
            |spec| spec.height = 1_000_000,
            |spec| spec.action_dim = 0,
            |spec| spec.action_dim = 1_000_000,
            |spec| spec.time_limit = 0,
        ];
        for (index, change) in broken.iter().enumerate() {
            let mut message = message();
            change(&mut message);
            assert!(spec(&message).is_err(), "{index}");
        }
    }

    #[test]
    fn metrics_are_kept_once_and_only_if_sane() {
        let metric = |name: &str, value| EnvironmentMetric {
            name: name.into(),
            value,
        };
        let row = EnvironmentRow {
            metrics: vec![
                metric("speed_m_s", 3.0),
                metric("speed_m_s", f64::NAN),
                metric(&"x".repeat(MAX_NAME_BYTES + 1), 1.0),
                metric("", 1.0),
            ],
            ..EnvironmentRow::default()
        };
        let (first, second) = (metrics(&row), metrics(&row));
        assert_eq!(first, [("speed_m_s", 3.0)]);
        assert!(std::ptr::eq(first[0].0, second[0].0));
    }
}
