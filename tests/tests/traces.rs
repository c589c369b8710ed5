//! What a collector of OpenTelemetry traces gets to see.

use std::collections::{BTreeMap, BTreeSet};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context, Result, ensure};
use isodream_tests::{binary, free_address};
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{
    TraceService, TraceServiceServer,
};
use opentelemetry_proto::tonic::collector::trace::v1::{
    ExportTraceServiceRequest, ExportTraceServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::KeyValue;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use tonic::transport::Server;
use tonic::{Request, Response, Status};

/// A collector that remembers spans by the service that they are of.
#[derive(Debug, Default, Clone)]
struct Collector(Arc<Mutex<BTreeMap<String, Vec<Span>>>>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        let mut seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        for of_resource in request.into_inner().resource_spans {
            let attributes = of_resource.resource.unwrap_or_default().attributes;
            let service = text(&attributes, "service.name").unwrap_or_default();
            let spans = of_resource.scope_spans.into_iter();
            seen.entry(service)
                .or_default()
                .extend(spans.flat_map(|scope| scope.spans));
        }
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

impl Collector {
    fn spans(&self, service: &str) -> Vec<Span> {
        let seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        seen.get(service).cloned().unwrap_or_default()
    }
}

fn text(attributes: &[KeyValue], key: &str) -> Option<String> {
    let value = attributes.iter().find(|pair| pair.key == key)?;
    match value.value.clone()?.value? {
        Value::StringValue(text) => Some(text),
        _ => None,
    }
}

fn train(folder: &std::path::Path, endpoint: &str) -> Result<std::process::Output> {
    Ok(Command::new(binary()?)
        .args(["train", "--preset", "debug", "--dashboard-listen", "off"])
        .arg("--run-dir")
        .arg(folder)
        .args(["--eval-episodes", "0", "--set", "learner.env_frames=1200"])
        .env("OTEL_EXPORTER_OTLP_ENDPOINT", endpoint)
        .stdin(Stdio::null())
        .output()?)
}

#[test]
fn every_role_tells_a_collector_what_it_spends_its_time_on() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let (address, collector) = (free_address()?, Collector::default());
    let runtime = tokio::runtime::Runtime::new()?;
    let service = TraceServiceServer::new(collector.clone());
    let listen = address.parse().context("an address")?;
    let server = runtime.spawn(Server::builder().add_service(service).serve(listen));
    let output = train(folder.path(), &format!("http://{address}"))?;
    let words = String::from_utf8_lossy(&output.stderr).into_owned();
    ensure!(output.status.success(), "{words}");
    ensure!(!server.is_finished(), "the collector ended");

    for (service, expected) in [
        (
            "isodream-learner",
            &[
                "learn",
                "publish_policy",
                "update",
                "wait_for_batch",
                "write_checkpoint",
            ][..],
        ),
        (
            "isodream-replay",
            &["append", "commit", "read_sequences", "wait_for_limiter"],
        ),
        ("isodream-actor", &["episode", "evaluate", "fetch_policy"]),
    ] {
        let spans = collector.spans(service);
        let names: BTreeSet<&str> = spans.iter().map(|span| span.name.as_str()).collect();
        let expected: BTreeSet<&str> = expected.iter().copied().collect();
        ensure!(
            names == expected,
            "{service} sent {names:?}, not {expected:?}"
        );
    }
    // What belongs together is told by parents within a role, and by attributes between roles.
    let learner = collector.spans("isodream-learner");
    let update = learner.iter().find(|span| span.name == "update");
    let update = update.context("there are updates")?;
    ensure!(
        learner
            .iter()
            .any(|span| span.name == "learn" && span.parent_span_id == update.span_id),
        "no learning within {update:?}"
    );
    let appends = collector.spans("isodream-replay").into_iter();
    let actors: BTreeSet<_> = appends
        .filter(|span| span.name == "append")
        .filter_map(|span| text(&span.attributes, "actor"))
        .collect();
    ensure!(actors.contains("actor-0"), "chunks came of {actors:?}");
    Ok(())
}

#[test]
fn a_collector_that_is_away_costs_the_run_nothing() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let output = train(folder.path(), &format!("http://{}", free_address()?))?;
    let words = String::from_utf8_lossy(&output.stderr).into_owned();
    ensure!(output.status.success(), "{words}");
    let log = std::fs::read_to_string(folder.path().join("logs/learner.log"))?;
    ensure!(
        log.contains("finished") && log.contains("BatchSpanProcessor"),
        "{log}"
    );
    Ok(())
}

#[test]
fn an_endpoint_that_is_none_is_refused_by_name() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let output = train(folder.path(), "not an address")?;
    let words = String::from_utf8_lossy(&output.stderr).into_owned();
    ensure!(
        !output.status.success() && words.contains("OTEL_EXPORTER_OTLP_ENDPOINT"),
        "{words}"
    );
    Ok(())
}
