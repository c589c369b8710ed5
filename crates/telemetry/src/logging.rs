//! Log lines on stderr; stdout stays free for what a command prints on purpose.

use std::env;
use std::io::{IsTerminal, stderr};

use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, Registry, fmt};

#[cfg(feature = "opentelemetry")]
use crate::traces::Traces;
use crate::{Error, Result};

/// The environment variable that overrides the default log filter.
pub const LOG_FILTER_VARIABLE: &str = "ISODREAM_LOG";

/// The form of a log line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LogFormat {
    /// For people: time, level, target, message, fields.
    #[default]
    Text,
    /// For log collectors: one JSON object per line.
    Json,
}

/// What has to live as long as the process logs; dropping it sends the last spans.
#[derive(Debug)]
#[must_use = "dropping it ends the traces"]
pub struct Logging {
    #[cfg(feature = "opentelemetry")]
    _traces: Option<Traces>,
}

/// Sends `tracing` events to stderr, filtered by [`LOG_FILTER_VARIABLE`] or else by `default_filter`
/// (for example `info`). Colours only on a terminal, and never where `NO_COLOR` is set.
///
/// With the feature `opentelemetry`, and where `OTEL_EXPORTER_OTLP_ENDPOINT` names a collector, spans go there as those of
/// `service`, whatever the filter says. Then it has to be called within a tokio runtime that outlives what it returns.
///
/// # Errors
/// [`Error::LogFilter`] on a filter that does not parse, [`Error::LoggingTwice`] on a second call, [`Error::Traces`] on an
/// endpoint that is none.
pub fn init_logging(default_filter: &str, format: LogFormat, service: &str) -> Result<Logging> {
    let filter = filter(env::var(LOG_FILTER_VARIABLE).ok(), default_filter)?;
    let no_color = env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    let lines = fmt::layer()
        .with_writer(stderr)
        .with_ansi(stderr().is_terminal() && !no_color);
    let lines: Box<dyn Layer<Registry> + Send + Sync> = match format {
        LogFormat::Text => lines.boxed(),
        LogFormat::Json => lines.json().flatten_event(true).boxed(),
    };
    let registry = Registry::default().with(lines.with_filter(filter));
    #[cfg(feature = "opentelemetry")]
    let (registry, _traces) = {
        let traces = Traces::from_environment(service)?;
        (registry.with(traces.as_ref().map(Traces::layer)), traces)
    };
    #[cfg(not(feature = "opentelemetry"))]
    let _ = service;
    registry.try_init().map_err(|_| Error::LoggingTwice)?;
    Ok(Logging {
        #[cfg(feature = "opentelemetry")]
        _traces,
    })
}

fn filter(from_environment: Option<String>, default_filter: &str) -> Result<EnvFilter> {
    let text = from_environment
        .filter(|text| !text.trim().is_empty())
        .unwrap_or_else(|| default_filter.to_owned());
    EnvFilter::try_new(&text).map_err(|error| Error::LogFilter {
        reason: error.to_string(),
        filter: text,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_environment_wins_over_the_default() {
        let text = |variable: Option<&str>| {
            filter(variable.map(str::to_owned), "info")
                .unwrap()
                .to_string()
        };
        assert_eq!(text(None), "info");
        assert_eq!(text(Some("  ")), "info");
        assert_eq!(text(Some("isodream_actor=debug")), "isodream_actor=debug");
    }

    #[test]
    fn a_filter_that_does_not_parse_is_named() {
        let error = filter(Some("isodream=loud".to_owned()), "info").unwrap_err();
        assert!(error.to_string().contains("`isodream=loud`"), "{error}");
    }

    #[test]
    fn a_second_initialisation_is_refused() {
        let _logging = init_logging("info", LogFormat::Text, "test").unwrap();
        assert!(matches!(
            init_logging("info", LogFormat::Json, "test"),
            Err(Error::LoggingTwice)
        ));
    }
}
