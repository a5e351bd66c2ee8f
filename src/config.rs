//! The command line: flags, each with an environment variable and a place in a file, parsed once.

pub mod file;

mod access;
mod identity;
mod limits;
mod mapping;
mod reconstruction;
mod units;

pub use access::{KeysArgs, KeysCommand, OrganisationsArgs, OrganisationsCommand, Quota};
pub use identity::OidcArgs;
pub use limits::Limits;
pub use mapping::StartJob;
pub use reconstruction::ReconstructionArgs;
use units::{parse_days, parse_megapixels, parse_seconds};

use crate::store::Bucket;
use axum::http::HeaderValue;
use clap::{Args, ValueEnum};
use heliomap_mapping::detection::{self, DetectionError, Detector, ExecutionProvider, RuntimeSettings};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

/// What is logged, to standard error.
#[derive(Debug, Clone, Args)]
pub struct LogArgs {
    /// Which events are logged: error, warn, info, debug, trace, or directives such as `heliomap=debug,warn`.
    #[arg(long, env = "HELIOMAP_LOG", default_value = "info", global = true, value_name = "FILTER")]
    pub log: String,
    /// How events are written.
    #[arg(long, env = "HELIOMAP_LOG_FORMAT", value_enum, default_value = "pretty", global = true)]
    pub log_format: LogFormat,
    /// A YAML file of settings, `flag: value` in each line. Flags and environment variables take precedence.
    #[arg(long, env = file::VARIABLE, global = true, value_name = "FILE")]
    pub config: Option<PathBuf>,
}

/// Where traces are sent.
#[derive(Debug, Clone, Default, Args)]
pub struct TraceArgs {
    /// An OpenTelemetry collector that receives traces of requests and jobs by OTLP over HTTP, `http://127.0.0.1:4318`. If
    /// absent, OTEL_EXPORTER_OTLP_TRACES_ENDPOINT and OTEL_EXPORTER_OTLP_ENDPOINT are used. The other OTEL_ variables set
    /// headers, sampling and batches.
    #[arg(long, env = "HELIOMAP_OTLP_ENDPOINT", global = true, value_name = "URL")]
    pub otlp_endpoint: Option<String>,
}

/// How events are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// A line for people.
    Pretty,
    /// A JSON object per line.
    Json,
}

/// `heliomap serve`.
#[derive(Debug, Clone, Args)]
pub struct ServeArgs {
    /// Address and port to listen on; port 0 takes a free one, which is printed.
    #[arg(long, env = "HELIOMAP_LISTEN", default_value = "127.0.0.1:8080", value_name = "ADDRESS")]
    pub listen: SocketAddr,
    /// Run no jobs in this process; leave them to `heliomap worker`.
    #[arg(long, env = "HELIOMAP_NO_WORKER")]
    pub no_worker: bool,
    /// Require no keys: everyone who can connect may do everything. Only on a loopback address.
    #[arg(long, env = "HELIOMAP_INSECURE")]
    pub insecure: bool,
    #[command(flatten)]
    pub storage: StorageArgs,
    #[command(flatten)]
    pub detector: DetectorArgs,
    #[command(flatten)]
    pub jobs: JobArgs,
    #[command(flatten)]
    pub stop: StopArgs,
    #[command(flatten)]
    pub network: NetworkArgs,
    #[command(flatten)]
    pub webhooks: WebhookArgs,
    #[command(flatten)]
    pub oidc: OidcArgs,
    #[command(flatten)]
    pub metrics: MetricsArgs,
    #[command(flatten)]
    pub retention: RetentionArgs,
    #[command(flatten)]
    pub limits: Limits,
}

/// What stands between the service and its clients.
#[derive(Debug, Clone, Default, Args)]
pub struct NetworkArgs {
    /// Origin of other web pages whose scripts may use the service, `https://dashboard.example.org`; may be repeated.
    #[arg(long, env = "HELIOMAP_CORS_ORIGIN", value_delimiter = ',', value_parser = parse_origin, value_name = "ORIGIN")]
    pub cors_origin: Vec<HeaderValue>,
    /// The service is behind a proxy: take clients' addresses from what it appends to `x-forwarded-for`.
    #[arg(long, env = "HELIOMAP_BEHIND_PROXY")]
    pub behind_proxy: bool,
}

/// Where messages about finished jobs may go.
#[derive(Debug, Clone, Default, Args)]
pub struct WebhookArgs {
    /// Allow webhooks to this machine, to private networks, and without TLS. Administrators of organisations can then make
    /// this service send requests to every address that it can reach.
    #[arg(long, env = "HELIOMAP_WEBHOOK_PRIVATE_TARGETS")]
    pub webhook_private_targets: bool,
}

/// Where the process serves its metrics.
#[derive(Debug, Clone, Default, Args)]
pub struct MetricsArgs {
    /// Address and port of a separate listener that serves `GET /metrics` in Prometheus' format and `GET /health`, without
    /// keys.
    #[arg(long, env = "HELIOMAP_METRICS_LISTEN", value_name = "ADDRESS")]
    pub metrics_listen: Option<SocketAddr>,
}

/// `heliomap worker`.
#[derive(Debug, Clone, Args)]
pub struct WorkerArgs {
    #[command(flatten)]
    pub webhooks: WebhookArgs,
    #[command(flatten)]
    pub metrics: MetricsArgs,
    #[command(flatten)]
    pub retention: RetentionArgs,
    #[command(flatten)]
    pub storage: StorageArgs,
    #[command(flatten)]
    pub detector: DetectorArgs,
    #[command(flatten)]
    pub jobs: JobArgs,
    #[command(flatten)]
    pub stop: StopArgs,
}

/// How long old data is kept.
#[derive(Debug, Clone, Args)]
pub struct RetentionArgs {
    /// How long the bytes of a replaced file are kept if nothing else needs them. No backup may take longer.
    #[arg(long, env = "HELIOMAP_KEEP_REPLACED", default_value = "24h", value_parser = parse_seconds, value_name = "DURATION")]
    pub keep_replaced: Duration,
    /// How long the audit log is kept.
    #[arg(long, env = "HELIOMAP_KEEP_AUDIT", default_value = "400d", value_parser = parse_days, value_name = "DURATION")]
    pub keep_audit: Duration,
}

/// How jobs are run.
#[derive(Debug, Clone, Args)]
pub struct JobArgs {
    /// Time without a heartbeat after which another worker takes over a job.
    #[arg(long, env = "HELIOMAP_LEASE", default_value = "30s", value_parser = parse_seconds, value_name = "DURATION")]
    pub lease: Duration,
}

/// How a service ends.
#[derive(Debug, Clone, Args)]
pub struct StopArgs {
    /// Time for requests in progress to finish after a signal to stop; jobs go back to the queue at once.
    #[arg(long, env = "HELIOMAP_GRACE", default_value = "20s", value_parser = parse_seconds, value_name = "DURATION")]
    pub grace: Duration,
}

/// `heliomap doctor`.
#[derive(Debug, Clone, Args)]
pub struct DoctorArgs {
    /// The settings that the service would have.
    #[command(flatten)]
    pub serve: ServeArgs,
    /// Print JSON: a list of checks, each with `name`, `verdict` (`ok`, `warning` or `failed`), `found` and `advice`.
    #[arg(long)]
    pub json: bool,
}

/// `heliomap backup`.
#[derive(Debug, Clone, Args)]
pub struct BackupArgs {
    /// Folder for the backup, new or empty; its layout is that of a data folder.
    #[arg(value_name = "FOLDER")]
    pub folder: PathBuf,
    #[command(flatten)]
    pub storage: StorageArgs,
}

/// `heliomap restore`.
#[derive(Debug, Clone, Args)]
pub struct RestoreArgs {
    /// Folder of the backup.
    #[arg(value_name = "FOLDER")]
    pub folder: PathBuf,
    #[command(flatten)]
    pub storage: StorageArgs,
}

/// `heliomap verify`.
#[derive(Debug, Clone, Args)]
pub struct VerifyArgs {
    /// Read every file and compare its digest, which takes longer.
    #[arg(long)]
    pub content: bool,
    #[command(flatten)]
    pub storage: StorageArgs,
}

/// `heliomap openapi`.
#[derive(Debug, Clone, Args)]
pub struct OpenapiArgs {
    /// Print JSON instead of YAML.
    #[arg(long)]
    pub json: bool,
}

/// Where the service keeps its data.
#[derive(Clone, Args)]
pub struct StorageArgs {
    /// Folder of the database and the uploaded files; created if missing.
    #[arg(long, env = "HELIOMAP_DATA_DIR", default_value = "heliomap-data", global = true, value_name = "DIR")]
    pub data_dir: PathBuf,
    /// Postgres database to use instead of the SQLite file in the data folder, `postgres://USER:PASSWORD@HOST/NAME`.
    #[arg(long, env = "HELIOMAP_DATABASE", hide_env_values = true, global = true, value_name = "URL")]
    pub database: Option<String>,
    /// S3-compatible store for uploaded files and models, instead of the data folder, `s3://BUCKET/PREFIX`. Endpoint, region
    /// and credentials come from AWS_ENDPOINT_URL, AWS_REGION, AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and the other usual
    /// variables.
    #[arg(long, env = "HELIOMAP_BLOBS", global = true, value_name = "URL")]
    pub blobs: Option<Bucket>,
}

/// Omits the database's URL, which may hold a password.
impl std::fmt::Debug for StorageArgs {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut known = f.debug_struct("StorageArgs");
        known.field("data_dir", &self.data_dir).field("blobs", &self.blobs).finish_non_exhaustive()
    }
}

/// The default detector.
const DETECTOR: &str = "both";

/// What finds modules in photos.
#[derive(Debug, Clone, Args)]
pub struct DetectorArgs {
    /// The detector: `unet`, `yolo` or `both` (shipped with heliomap), or your own ONNX files, at most one of each kind.
    #[arg(long, env = "HELIOMAP_DETECTOR", default_value = DETECTOR, value_delimiter = ',', value_name = "DETECTOR")]
    pub detector: Vec<String>,
    /// What runs the detector: `cpu`, or `cuda` if your ONNX Runtime (ORT_DYLIB_PATH) was built with it.
    #[arg(long, env = "HELIOMAP_EXECUTION_PROVIDER", default_value = "cpu", value_name = "PROVIDER")]
    pub execution_provider: ExecutionProvider,
}

impl DetectorArgs {
    /// Whether the models, the execution provider or the library of ONNX Runtime differ from the defaults.
    pub fn is_own(&self) -> bool {
        self.detector != [DETECTOR]
            || self.execution_provider != ExecutionProvider::default()
            || std::env::var_os("ORT_DYLIB_PATH").is_some_and(|path| !path.is_empty())
    }

    /// Opens the detector, which runs on so many threads; 0 is one per core.
    ///
    /// # Errors
    /// As [`detection::open`].
    pub fn open(&self, threads: usize) -> Result<Box<dyn Detector>, DetectionError> {
        detection::open(&self.detector, RuntimeSettings { threads, provider: self.execution_provider })
    }
}

/// The largest photo that single commands take.
#[derive(Debug, Clone, Copy, Args)]
pub struct ImageSizeArgs {
    /// Largest image, in millions of pixels; checked before an image is decoded.
    #[arg(long, alias = "max-megapixels", env = "HELIOMAP_MAX_IMAGE_MEGAPIXELS", default_value = "100", value_parser = parse_megapixels, value_name = "MP")]
    pub max_image_megapixels: f64,
}

impl ImageSizeArgs {
    /// The limit in pixels.
    pub fn max_pixels(self) -> u64 {
        (self.max_image_megapixels * 1e6) as u64
    }
}

/// An origin as browsers write it: scheme, host and port, without a slash at the end.
fn parse_origin(text: &str) -> Result<HeaderValue, String> {
    let host = text.strip_prefix("https://").or_else(|| text.strip_prefix("http://")).unwrap_or_default();
    let value = HeaderValue::from_str(text).ok();
    value.filter(|_| !host.is_empty() && !host.contains(['/', '*', '?', '#', ' '])).ok_or_else(|| {
        "an origin is a scheme and a host, such as https://dashboard.example.org, with nothing behind it".to_owned()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn origins() {
        assert!(parse_origin("https://dashboard.example.org").is_ok() && parse_origin("http://localhost:5173").is_ok());
        for wrong in
            ["", "*", "dashboard.example.org", "https://", "https://a/", "https://*.example.org", "https://a\n"]
        {
            assert!(parse_origin(wrong).is_err(), "{wrong}");
        }
    }
}
