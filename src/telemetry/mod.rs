//! Structured events to standard error, metrics, and traces.

pub mod metrics;
pub mod traces;

pub use metrics::Metrics;
pub use traces::Traces;

use crate::config::{LogArgs, LogFormat, TraceArgs};
use opentelemetry_otlp::ExporterBuildError;
use tracing::level_filters::LevelFilter;
use tracing_subscriber::filter::{ParseError, Targets};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, fmt};

/// Why telemetry cannot start.
#[derive(Debug, thiserror::Error)]
pub enum TelemetryError {
    #[error("--log: {0}")]
    Filter(#[from] ParseError),
    #[error("traces cannot be sent: {0}; see --otlp-endpoint")]
    Exporter(#[from] ExporterBuildError),
}

/// Starts logging and, if configured, tracing. Call once; the returned value sends the last traces.
pub fn init(log: &LogArgs, traces: &TraceArgs) -> Result<Option<Traces>, TelemetryError> {
    let filter = EnvFilter::try_new(&log.log)?;
    let logs = fmt::layer().with_writer(std::io::stderr);
    let logs = match log.log_format {
        LogFormat::Pretty => logs.boxed(),
        LogFormat::Json => logs.json().flatten_event(true).boxed(),
    };
    // Traces do not depend on the log filter: they hold the spans of this program, not those of libraries.
    let (layer, traces) = traces::layer(traces)?.unzip();
    let layer = layer.map(|layer| layer.with_filter(Targets::new().with_target("heliomap", LevelFilter::INFO)));
    tracing_subscriber::registry().with(logs.with_filter(filter)).with(layer).init();
    Ok(traces)
}
