//! Traces of requests, jobs and their stages for an OpenTelemetry collector, if one is configured.

use crate::config::TraceArgs;
use axum::http::HeaderMap;
use opentelemetry::Context;
use opentelemetry::propagation::{Extractor, TextMapPropagator};
use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::{ExporterBuildError, Protocol, SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::{SdkTracer, SdkTracerProvider};
use std::sync::atomic::{AtomicBool, Ordering};
use tracing::{Span, Subscriber};
use tracing_opentelemetry::{OpenTelemetryLayer, OpenTelemetrySpanExt};
use tracing_subscriber::registry::LookupSpan;

/// The standard variables that name a collector.
const VARIABLES: [&str; 2] = ["OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT"];
/// Where a collector takes traces.
const PATH: &str = "/v1/traces";

/// Whether this process sends traces.
static ON: AtomicBool = AtomicBool::new(false);

/// What sends the traces of this process.
#[derive(Debug)]
pub struct Traces(SdkTracerProvider);

impl Traces {
    /// Sends what is not sent yet. Call at the end of the process, outside of the asynchronous runtime.
    pub fn end(self) {
        if let Err(error) = self.0.shutdown() {
            tracing::warn!(%error, "some traces were not sent");
        }
    }
}

/// The layer that turns spans into traces, and their sender; `None` without a collector.
///
/// # Errors
/// When the collector's address cannot be used.
#[expect(clippy::type_complexity, reason = "the type of a layer names its subscriber")]
pub fn layer<S: Subscriber + for<'span> LookupSpan<'span>>(
    args: &TraceArgs,
) -> Result<Option<(OpenTelemetryLayer<S, SdkTracer>, Traces)>, ExporterBuildError> {
    let is_set = |name: &&str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    if args.otlp_endpoint.is_none() && !VARIABLES.iter().any(is_set) {
        return Ok(None);
    }
    crate::tls::provide();
    let exporter = SpanExporter::builder().with_http().with_protocol(Protocol::HttpBinary);
    let exporter = match &args.otlp_endpoint {
        Some(endpoint) => exporter.with_endpoint(format!("{}{PATH}", endpoint.trim_end_matches('/'))),
        None => exporter,
    };
    let mut resource = Resource::builder();
    if !is_set(&"OTEL_SERVICE_NAME") {
        resource = resource.with_service_name("heliomap");
    }
    let version = opentelemetry::KeyValue::new("service.version", env!("CARGO_PKG_VERSION"));
    let resource = resource.with_attribute(version).build();
    let provider = SdkTracerProvider::builder().with_batch_exporter(exporter.build()?).with_resource(resource).build();
    ON.store(true, Ordering::Relaxed);
    let layer = tracing_opentelemetry::layer().with_tracer(provider.tracer("heliomap"));
    Ok(Some((layer, Traces(provider))))
}

/// Whether this process sends traces.
pub fn are_on() -> bool {
    ON.load(Ordering::Relaxed)
}

/// Makes a span part of the client's trace (W3C Trace Context), if the request has one.
pub fn join(span: &Span, headers: &HeaderMap) {
    if headers.contains_key("traceparent") {
        let context: Context = TraceContextPropagator::new().extract(&Headers(headers));
        // Where the span is not traced there is nothing to join.
        let _ = span.set_parent(context);
    }
}

struct Headers<'a>(&'a HeaderMap);

impl Extractor for Headers<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key)?.to_str().ok()
    }

    fn keys(&self) -> Vec<&str> {
        self.0.keys().map(|name| name.as_str()).collect()
    }
}
