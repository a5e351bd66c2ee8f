//! Metrics of the service, in Prometheus' format.

use crate::store::{Blobs, Store};
use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{Registry, Unit};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

/// The media type of the text form.
const OPENMETRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Upper ends of the buckets of answering times, seconds.
const ANSWER_S: [f64; 12] = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 5.0, 30.0];
/// Upper ends of the buckets of the times of jobs and their stages, seconds.
const JOB_S: [f64; 12] = [0.1, 0.5, 1.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 7200.0];

/// A request by its route, as the router knows it: what clients put into paths makes no new series.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub struct RequestLabels {
    pub method: String,
    pub route: String,
    pub status: u16,
}

/// A stage of a mapping.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub struct StageLabels {
    pub stage: String,
}

/// How something ended.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub struct OutcomeLabels {
    pub outcome: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct StateLabels {
    state: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct PoolLabels {
    pool: &'static str,
    state: &'static str,
}

type Seconds = Gauge<f64, AtomicU64>;

/// The metrics of this process; clones share them.
#[derive(Debug, Clone)]
pub struct Metrics {
    pub requests: Family<RequestLabels, Counter>,
    pub request_seconds: Family<RequestLabels, Histogram, fn() -> Histogram>,
    pub requests_in_flight: Gauge,
    pub upload_bytes: Counter,
    /// Attempts at jobs, by outcome.
    pub attempts: Family<OutcomeLabels, Counter>,
    /// Images of other workers' jobs that this one searched.
    pub images_helped: Counter,
    pub stage_seconds: Family<StageLabels, Histogram, fn() -> Histogram>,
    /// Messages to webhooks, by outcome.
    pub deliveries: Family<OutcomeLabels, Counter>,
    jobs: Family<StateLabels, Gauge>,
    queue_depth: Gauge,
    images_waiting: Gauge,
    queue_age_seconds: Seconds,
    connections: Family<PoolLabels, Gauge>,
    disk_free_bytes: Gauge,
    registry: Arc<Registry>,
}

impl Default for Metrics {
    fn default() -> Self {
        let answers: fn() -> Histogram = || Histogram::new(ANSWER_S);
        let works: fn() -> Histogram = || Histogram::new(JOB_S);
        let mut metrics = Self {
            requests: Family::default(),
            request_seconds: Family::new_with_constructor(answers),
            requests_in_flight: Gauge::default(),
            upload_bytes: Counter::default(),
            attempts: Family::default(),
            images_helped: Counter::default(),
            stage_seconds: Family::new_with_constructor(works),
            deliveries: Family::default(),
            jobs: Family::default(),
            queue_depth: Gauge::default(),
            images_waiting: Gauge::default(),
            queue_age_seconds: Gauge::default(),
            connections: Family::default(),
            disk_free_bytes: Gauge::default(),
            registry: Arc::default(),
        };
        let mut registry = Registry::with_prefix("heliomap");
        registry.register("requests", "Requests answered", metrics.requests.clone());
        registry.register_with_unit(
            "request",
            "Time from the head of a request to the head of its response",
            Unit::Seconds,
            metrics.request_seconds.clone(),
        );
        registry.register("requests_in_flight", "Requests being answered", metrics.requests_in_flight.clone());
        registry.register_with_unit("upload", "Bytes of uploads received", Unit::Bytes, metrics.upload_bytes.clone());
        registry.register(
            "images_helped",
            "Images of other workers' jobs that this process searched",
            metrics.images_helped.clone(),
        );
        registry.register("job_attempts", "Attempts at jobs by outcome", metrics.attempts.clone());
        registry.register_with_unit(
            "stage",
            "Time of each stage of mappings that were not resumed",
            Unit::Seconds,
            metrics.stage_seconds.clone(),
        );
        let deliveries = metrics.deliveries.clone();
        registry.register("webhook_deliveries", "Messages sent to webhooks by outcome", deliveries);
        registry.register("jobs", "Jobs by state, of all organisations and processes", metrics.jobs.clone());
        registry.register("queue_depth", "Queued jobs", metrics.queue_depth.clone());
        registry.register(
            "images_waiting",
            "Images of running jobs that wait for a worker",
            metrics.images_waiting.clone(),
        );
        registry.register_with_unit(
            "queue_age",
            "Waiting time of the oldest queued job",
            Unit::Seconds,
            metrics.queue_age_seconds.clone(),
        );
        registry.register("database_connections", "Connections of this process", metrics.connections.clone());
        registry.register_with_unit(
            "disk_free",
            "Free space of the data folder",
            Unit::Bytes,
            metrics.disk_free_bytes.clone(),
        );
        metrics.registry = Arc::new(registry);
        metrics
    }
}

impl Metrics {
    /// Counts an answer.
    pub fn answered(&self, labels: &RequestLabels, took: Duration) {
        self.requests.get_or_create(labels).inc();
        self.request_seconds.get_or_create(labels).observe(took.as_secs_f64());
    }

    /// Counts what the stages of a mapping took.
    pub fn mapped(&self, stage_ms: &BTreeMap<String, u64>) {
        for (stage, ms) in stage_ms {
            self.stage_seconds.get_or_create(&StageLabels { stage: stage.clone() }).observe(*ms as f64 / 1e3);
        }
    }

    /// The text form, with the queue and the disk as they are now.
    ///
    /// # Errors
    /// Where the database does not answer.
    pub async fn render(&self, store: &dyn Store, blobs: &Blobs) -> Result<String, crate::store::StoreError> {
        let queue = store.queue(jiff::Timestamp::now()).await?;
        for (state, count) in queue.jobs {
            self.jobs.get_or_create(&StateLabels { state: state.as_str() }).set(count as i64);
        }
        self.queue_depth.set(queue.waiting as i64);
        self.images_waiting.set(queue.images as i64);
        self.queue_age_seconds.set(queue.oldest.map_or(0.0, |age| age.as_secs_f64()));
        for pool in store.pools() {
            for (state, count) in [("idle", pool.idle), ("used", pool.open.saturating_sub(pool.idle))] {
                self.connections.get_or_create(&PoolLabels { pool: pool.name, state }).set(count as i64);
            }
        }
        self.disk_free_bytes.set(i64::try_from(blobs.free_bytes()?).unwrap_or(i64::MAX));
        let mut text = String::new();
        // Writing to a string does not fail.
        let _ = encode(&mut text, &self.registry);
        Ok(text)
    }
}

/// What `/metrics` looks at.
#[derive(Clone)]
pub struct Scrape {
    pub metrics: Metrics,
    pub store: Arc<dyn Store>,
    pub blobs: Blobs,
}

/// `GET /metrics` on a separate listener, because it covers all organisations, and `GET /health`, which answers there
/// however many connections clients hold.
pub fn router(scrape: Scrape) -> Router {
    Router::new()
        .route("/metrics", get(serve))
        .route("/health", get(async || StatusCode::NO_CONTENT))
        .with_state(scrape)
}

async fn serve(State(scrape): State<Scrape>) -> Response {
    match scrape.metrics.render(&*scrape.store, &scrape.blobs).await {
        Ok(text) => ([(header::CONTENT_TYPE, OPENMETRICS)], text).into_response(),
        Err(error) => {
            tracing::error!(%error, "cannot collect the metrics");
            StatusCode::SERVICE_UNAVAILABLE.into_response()
        }
    }
}
