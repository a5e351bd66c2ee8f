//! The command line: flags, each with an environment variable and a place in a file, parsed once.

pub mod file;

use crate::detection::{self, DetectionError, Detector, ExecutionProvider, RuntimeSettings};
use crate::oidc::{OidcSettings, OrganisationRule};
use crate::plant::PlantId;
use crate::store::usage::{Quotas, UNLIMITED};
use crate::store::{Bucket, KeyId, Scope};
use crate::webhooks::Targets;
use axum::http::HeaderValue;
use clap::{Args, Subcommand, ValueEnum};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

/// What is logged, to standard error.
#[derive(Debug, Clone, Args)]
pub struct LogArgs {
    /// Which events are logged: error, warn, info, debug, trace, or directives such as `heliomap=debug,warn`.
    #[arg(long, env = "HELIOMAP_LOG", default_value = "info", global = true, value_name = "FILTER")]
    pub log: String,
    /// How they are written.
    #[arg(long, env = "HELIOMAP_LOG_FORMAT", value_enum, default_value = "pretty", global = true)]
    pub log_format: LogFormat,
    /// A YAML file of settings, `flag: value` in each line; flags and environment go before it.
    #[arg(long, env = file::VARIABLE, global = true, value_name = "FILE")]
    pub config: Option<PathBuf>,
}

/// Where traces are sent.
#[derive(Debug, Clone, Default, Args)]
pub struct TraceArgs {
    /// An OpenTelemetry collector to send traces of requests and jobs to, by OTLP over HTTP, `http://127.0.0.1:4318`. Where it
    /// is not given, the variables OTEL_EXPORTER_OTLP_ENDPOINT and OTEL_EXPORTER_OTLP_TRACES_ENDPOINT count; headers, sampling
    /// and batches are set by the other OTEL_ variables.
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
    /// Ask for no keys: whoever reaches the service may do everything. Only on a loopback address.
    #[arg(long, env = "HELIOMAP_INSECURE")]
    pub insecure: bool,
    #[command(flatten)]
    pub storage: StorageArgs,
    #[command(flatten)]
    pub detector: DetectorArgs,
    #[command(flatten)]
    pub jobs: JobArgs,
    #[command(flatten)]
    pub network: NetworkArgs,
    #[command(flatten)]
    pub webhooks: WebhookArgs,
    #[command(flatten)]
    pub oidc: OidcArgs,
    #[command(flatten)]
    pub metrics: MetricsArgs,
    #[command(flatten)]
    pub limits: Limits,
}

/// What stands between the service and its clients.
#[derive(Debug, Clone, Default, Args)]
pub struct NetworkArgs {
    /// Origin of web pages elsewhere whose scripts may use the service, `https://dashboard.example.org`; may be given more
    /// than once.
    #[arg(long, env = "HELIOMAP_CORS_ORIGIN", value_delimiter = ',', value_parser = parse_origin, value_name = "ORIGIN")]
    pub cors_origin: Vec<HeaderValue>,
    /// A proxy stands in front: clients' addresses are what it appends to `x-forwarded-for`.
    #[arg(long, env = "HELIOMAP_BEHIND_PROXY")]
    pub behind_proxy: bool,
}

/// Who is told of the ends of jobs.
#[derive(Debug, Clone, Default, Args)]
pub struct WebhookArgs {
    /// Let webhooks lead to this machine and to private networks, and be told without TLS. Whoever may make webhooks can then
    /// have this service send requests to whatever it can reach.
    #[arg(long, env = "HELIOMAP_WEBHOOK_PRIVATE_TARGETS")]
    pub webhook_private_targets: bool,
}

impl WebhookArgs {
    /// Where they may lead.
    pub fn targets(&self) -> Targets {
        if self.webhook_private_targets { Targets::Any } else { Targets::Public }
    }
}

/// Whose tokens let in beside keys.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Identity provider")]
pub struct OidcArgs {
    /// An OpenID Connect provider whose tokens (RS256, ES256 or EdDSA) let in beside keys, by its `issuer`, to the letter.
    #[arg(long, env = "HELIOMAP_OIDC_ISSUER", value_name = "URL")]
    pub oidc_issuer: Option<String>,
    /// What must stand in a token's `aud`.
    #[arg(long, env = "HELIOMAP_OIDC_AUDIENCE", value_name = "NAME")]
    pub oidc_audience: Option<String>,
    /// The claim that names the caller's organisation; dots lead into claims within claims.
    #[arg(long, env = "HELIOMAP_OIDC_ORGANISATION_CLAIM", default_value = "organisation", value_name = "CLAIM")]
    pub oidc_organisation_claim: String,
    /// The organisation of all callers, whatever their tokens say.
    #[arg(long, env = "HELIOMAP_OIDC_ORGANISATION", value_name = "NAME")]
    pub oidc_organisation: Option<String>,
    /// The claim that says what a caller may do: words with blanks between them, or a list.
    #[arg(long, env = "HELIOMAP_OIDC_SCOPE_CLAIM", default_value = "scope", value_name = "CLAIM")]
    pub oidc_scope_claim: String,
    /// What a word of that claim stands for, `plant-admins=admin`; may be given more than once.
    #[arg(long, env = "HELIOMAP_OIDC_SCOPE", value_delimiter = ',', value_parser = parse_scope_word, value_name = "WORD=SCOPE",
        default_value = "heliomap:upload=upload,heliomap:read=read,heliomap:review=review,heliomap:admin=admin")]
    pub oidc_scope: Vec<(String, Scope)>,
}

/// The least time between two fetches of a provider's keys.
const MIN_KEY_REFRESH: Duration = Duration::from_secs(10);

impl OidcArgs {
    /// What tokens are checked by; `None` where no provider is named.
    ///
    /// # Errors
    /// Where it is not said for whom its tokens must be.
    pub fn settings(&self) -> Result<Option<OidcSettings>, &'static str> {
        let Some(issuer) = self.oidc_issuer.clone() else { return Ok(None) };
        let audience =
            self.oidc_audience.clone().ok_or("--oidc-issuer needs --oidc-audience: what stands in a token's `aud`")?;
        let organisation = match &self.oidc_organisation {
            Some(name) => OrganisationRule::Named(name.clone()),
            None => OrganisationRule::Claim(self.oidc_organisation_claim.clone()),
        };
        Ok(Some(OidcSettings {
            issuer,
            audience,
            organisation,
            scope_claim: self.oidc_scope_claim.clone(),
            scopes: self.oidc_scope.clone(),
            min_refresh: MIN_KEY_REFRESH,
        }))
    }
}

fn parse_scope_word(text: &str) -> Result<(String, Scope), String> {
    let parsed = text.rsplit_once('=').and_then(|(word, scope)| Some((word.to_owned(), scope.parse().ok()?)));
    parsed.filter(|(word, _)| !word.is_empty()).ok_or_else(|| {
        "a word and what it stands for are expected, one of upload, read, review and admin: plant-admins=admin"
            .to_owned()
    })
}

/// Where the process tells what it counts.
#[derive(Debug, Clone, Default, Args)]
pub struct MetricsArgs {
    /// Address and port of a listener of its own that answers `GET /metrics` in Prometheus' form, to whoever asks.
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
    pub storage: StorageArgs,
    #[command(flatten)]
    pub detector: DetectorArgs,
    #[command(flatten)]
    pub jobs: JobArgs,
}

/// How jobs are run.
#[derive(Debug, Clone, Args)]
pub struct JobArgs {
    /// Seconds after which a job whose worker fell silent is taken up by another.
    #[arg(long, env = "HELIOMAP_LEASE", default_value = "30", value_parser = parse_seconds, value_name = "SECONDS")]
    pub lease: Duration,
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

/// `heliomap keys`.
#[derive(Debug, Clone, Args)]
pub struct KeysArgs {
    #[command(flatten)]
    pub storage: StorageArgs,
    #[command(subcommand)]
    pub command: KeysCommand,
}

/// What is done about keys.
#[derive(Debug, Clone, Subcommand)]
pub enum KeysCommand {
    /// Make a key and print its secret, which is kept nowhere.
    Create {
        /// What people call it.
        #[arg(long, value_name = "NAME")]
        name: String,
        /// What it is good for; may be given more than once.
        #[arg(long, value_enum, value_name = "SCOPE", required = true)]
        scope: Vec<Scope>,
        /// The organisation that it belongs to, by name; made where there is none.
        #[arg(long, value_name = "NAME", default_value = "default")]
        organisation: String,
        /// A plant that it is good for; may be given more than once; all plants where it is not given.
        #[arg(long, value_name = "UUID")]
        plant: Vec<PlantId>,
        /// Days after which it ends; never where it is not given.
        #[arg(long, value_name = "N")]
        days: Option<u32>,
    },
    /// List all keys.
    List,
    /// Make a key good for nothing, for ever.
    Revoke {
        /// The key's identifier.
        #[arg(value_parser = parse_key_id, value_name = "UUID")]
        id: KeyId,
    },
    /// Give a key a new secret and print it.
    Rotate {
        /// The key's identifier.
        #[arg(value_parser = parse_key_id, value_name = "UUID")]
        id: KeyId,
        /// Hours for which the secret so far stays good.
        #[arg(long, value_name = "N", default_value_t = 0)]
        grace_hours: u32,
    },
}

fn parse_key_id(text: &str) -> Result<KeyId, uuid::Error> {
    text.parse().map(KeyId)
}

/// `heliomap organisations`.
#[derive(Debug, Clone, Args)]
pub struct OrganisationsArgs {
    #[command(flatten)]
    pub storage: StorageArgs,
    #[command(subcommand)]
    pub command: OrganisationsCommand,
}

/// What is done about organisations.
#[derive(Debug, Clone, Subcommand)]
pub enum OrganisationsCommand {
    /// List all organisations with what they keep and may keep.
    List,
    /// Make an organisation, or find the one of that name.
    Create {
        /// The organisation's name.
        #[arg(value_name = "NAME")]
        name: String,
    },
    /// Say what an organisation may keep; what is not given stays as it is.
    Quota {
        /// The organisation's name.
        #[arg(value_name = "NAME")]
        name: String,
        /// Bytes of files and models: a size such as 500G, `unlimited`, or `default` for what `--quota-bytes` says.
        #[arg(long, value_name = "SIZE", value_parser = parse_quota)]
        bytes: Option<Quota>,
        /// Plants: a number, `unlimited`, or `default` for what `--quota-plants` says.
        #[arg(long, value_name = "COUNT", value_parser = parse_quota)]
        plants: Option<Quota>,
    },
}

/// A quota of an organisation; `None` for what holds for all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quota(pub Option<u64>);

fn parse_quota(text: &str) -> Result<Quota, String> {
    match text {
        "default" => Ok(Quota(None)),
        "unlimited" => Ok(Quota(Some(UNLIMITED))),
        text => parse_size(text).map(|size| Quota(Some(size))),
    }
}

/// `heliomap backup`.
#[derive(Debug, Clone, Args)]
pub struct BackupArgs {
    /// Folder for the backup, new or empty; rows and blobs lie in it as in a data folder.
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
    /// Read every file and compare its digest, which takes its time.
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

/// Where the service keeps what it remembers.
#[derive(Clone, Args)]
pub struct StorageArgs {
    /// Folder of the database and the uploaded files; created where it is missing.
    #[arg(long, env = "HELIOMAP_DATA_DIR", default_value = "heliomap-data", value_name = "DIR")]
    pub data_dir: PathBuf,
    /// Postgres database to use in place of the SQLite file in the data folder, `postgres://USER:PASSWORD@HOST/NAME`.
    #[arg(long, env = "HELIOMAP_DATABASE", hide_env_values = true, value_name = "URL")]
    pub database: Option<String>,
    /// Place in an S3-compatible store for the uploaded files and the models, in place of the data folder,
    /// `s3://BUCKET/PREFIX`. Endpoint, region and credentials come from the variables AWS_ENDPOINT_URL, AWS_REGION,
    /// AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and the others that programs for S3 take.
    #[arg(long, env = "HELIOMAP_BLOBS", value_name = "URL")]
    pub blobs: Option<Bucket>,
}

/// The database's URL may hold a password, which no log shall.
impl std::fmt::Debug for StorageArgs {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut known = f.debug_struct("StorageArgs");
        known.field("data_dir", &self.data_dir).field("blobs", &self.blobs).finish_non_exhaustive()
    }
}

/// What finds modules in photos.
#[derive(Debug, Clone, Args)]
pub struct DetectorArgs {
    /// The detector: `unet`, `yolo` or `both` (they come with heliomap), or ONNX files of your own, one of each kind at most.
    #[arg(long, env = "HELIOMAP_DETECTOR", default_value = "both", value_delimiter = ',', value_name = "DETECTOR")]
    pub detector: Vec<String>,
    /// What runs the detector: cpu, or cuda, tensorrt, migraphx, openvino, xnnpack, coreml, directml where
    /// your ONNX Runtime (ORT_DYLIB_PATH) was built with it.
    #[arg(long, env = "HELIOMAP_EXECUTION_PROVIDER", default_value = "cpu", value_name = "PROVIDER")]
    pub execution_provider: ExecutionProvider,
}

impl DetectorArgs {
    /// Opens the detector, which runs on so many threads; 0 is one per core.
    ///
    /// # Errors
    /// As [`detection::open`].
    pub fn open(&self, threads: usize) -> Result<Box<dyn Detector>, DetectionError> {
        detection::open(&self.detector, RuntimeSettings { threads, provider: self.execution_provider })
    }
}

/// How much one client may ask for. Sizes take the endings K, M, G and T (powers of 1024).
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Limits")]
pub struct Limits {
    /// Largest image file.
    #[arg(long, env = "HELIOMAP_MAX_IMAGE_SIZE", default_value = "256M", value_parser = parse_size, value_name = "SIZE")]
    pub max_image_size: u64,
    /// Largest image, in millions of pixels; checked before an image is decoded.
    #[arg(long, env = "HELIOMAP_MAX_IMAGE_MEGAPIXELS", default_value_t = 100.0, value_name = "MP")]
    pub max_image_megapixels: f64,
    /// Largest single file of a reconstruction.
    #[arg(long, env = "HELIOMAP_MAX_FILE_SIZE", default_value = "8G", value_parser = parse_size, value_name = "SIZE")]
    pub max_file_size: u64,
    /// Largest zip or tar.
    #[arg(long, env = "HELIOMAP_MAX_ARCHIVE_SIZE", default_value = "16G", value_parser = parse_size, value_name = "SIZE")]
    pub max_archive_size: u64,
    /// Largest sum of the files in a zip or tar.
    #[arg(long, env = "HELIOMAP_MAX_UNPACKED_SIZE", default_value = "64G", value_parser = parse_size, value_name = "SIZE")]
    pub max_unpacked_size: u64,
    /// How many times as large as the zip or tar its files may be, from 64 MiB on.
    #[arg(long, env = "HELIOMAP_MAX_UNPACKED_RATIO", default_value_t = 50, value_name = "TIMES")]
    pub max_unpacked_ratio: u64,
    /// Most entries in a zip or tar, and most images in one multipart upload.
    #[arg(long, env = "HELIOMAP_MAX_ENTRIES", default_value_t = 20_000, value_name = "COUNT")]
    pub max_entries: usize,
    /// How often a job is started without getting anywhere before it fails.
    #[arg(long, env = "HELIOMAP_MAX_ATTEMPTS", default_value_t = 3, value_name = "COUNT")]
    pub max_attempts: u32,
    /// How long an upload may stand still, and any other request may take, in seconds.
    #[arg(long, env = "HELIOMAP_REQUEST_TIMEOUT", default_value = "30", value_parser = parse_seconds, value_name = "SECONDS")]
    pub request_timeout: Duration,
    /// Requests per second of one key, on average; for a moment twice as many.
    #[arg(long, env = "HELIOMAP_MAX_REQUESTS_PER_SECOND", default_value_t = 300, value_parser = clap::value_parser!(u32).range(1..), value_name = "COUNT")]
    pub max_requests_per_second: u32,
    /// Requests per minute without a good key from one address before it is told to wait.
    #[arg(long, env = "HELIOMAP_MAX_FAILED_LOGINS_PER_MINUTE", default_value_t = 300, value_parser = clap::value_parser!(u32).range(1..), value_name = "COUNT")]
    pub max_failed_logins_per_minute: u32,
    /// Most connections at once; more wait.
    #[arg(long, env = "HELIOMAP_MAX_CONNECTIONS", default_value_t = 1024, value_name = "COUNT")]
    pub max_connections: usize,
    /// Free space of the data folder's disk that uploads leave to running jobs.
    #[arg(long, env = "HELIOMAP_DISK_RESERVE", default_value = "1G", value_parser = parse_size, value_name = "SIZE")]
    pub disk_reserve: u64,
    /// Most bytes of files and models that an organisation may keep, unless `heliomap organisations quota` says otherwise of
    /// it; no bound where it is not given.
    #[arg(long, env = "HELIOMAP_QUOTA_BYTES", value_parser = parse_size, value_name = "SIZE")]
    pub quota_bytes: Option<u64>,
    /// Most plants that an organisation may have, unless `heliomap organisations quota` says otherwise of it; no bound where it
    /// is not given.
    #[arg(long, env = "HELIOMAP_QUOTA_PLANTS", value_name = "COUNT")]
    pub quota_plants: Option<u64>,
}

impl Limits {
    /// What every organisation may keep of which nothing else was said.
    pub fn quotas(&self) -> Quotas {
        Quotas { bytes: self.quota_bytes, plants: self.quota_plants }
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_image_size: 256 << 20,
            max_image_megapixels: 100.0,
            max_file_size: 8 << 30,
            max_archive_size: 16 << 30,
            max_unpacked_size: 64 << 30,
            max_unpacked_ratio: 50,
            max_entries: 20_000,
            max_attempts: 3,
            request_timeout: Duration::from_secs(30),
            max_requests_per_second: 300,
            max_failed_logins_per_minute: 300,
            max_connections: 1024,
            disk_reserve: 1 << 30,
            quota_bytes: None,
            quota_plants: None,
        }
    }
}

fn parse_size(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| !c.is_ascii_digit());
    let shift = match text[digits.len()..].trim().to_ascii_uppercase().trim_end_matches("IB").trim_end_matches('B') {
        "" => 0,
        "K" => 10,
        "M" => 20,
        "G" => 30,
        "T" => 40,
        _ => return Err("a size is a whole number with K, M, G or T behind it, such as 256M".to_owned()),
    };
    let number: u64 = digits.parse().map_err(|_| "a size begins with a whole number, such as 256M".to_owned())?;
    number.checked_mul(1 << shift).ok_or_else(|| "the size is too large".to_owned())
}

/// An origin as browsers write it: scheme, host and port, without a slash at the end.
fn parse_origin(text: &str) -> Result<HeaderValue, String> {
    let host = text.strip_prefix("https://").or_else(|| text.strip_prefix("http://")).unwrap_or_default();
    let value = HeaderValue::from_str(text).ok();
    value.filter(|_| !host.is_empty() && !host.contains(['/', '*', '?', '#', ' '])).ok_or_else(|| {
        "an origin is a scheme and a host, such as https://dashboard.example.org, with nothing behind it".to_owned()
    })
}

fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse::<f64>().map_err(|_| "a number of seconds is expected".to_owned())?;
    match Duration::try_from_secs_f64(seconds) {
        Ok(duration) if !duration.is_zero() => Ok(duration),
        _ => Err("a positive number of seconds is expected".to_owned()),
    }
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

    #[test]
    fn words_of_claims() {
        assert_eq!(parse_scope_word("plant=admins=admin"), Ok(("plant=admins".to_owned(), Scope::Admin)));
        assert!(parse_scope_word("admin").is_err() && parse_scope_word("=admin").is_err());
        assert!(parse_scope_word("a=everything").is_err());
    }

    #[test]
    fn quotas() {
        assert_eq!(parse_quota("500G"), Ok(Quota(Some(500 << 30))));
        assert_eq!(parse_quota("unlimited"), Ok(Quota(Some(UNLIMITED))));
        assert_eq!(parse_quota("default"), Ok(Quota(None)));
        assert!(parse_quota("much").is_err());
    }

    #[test]
    fn sizes() {
        assert_eq!(parse_size("256M"), Ok(256 << 20));
        assert_eq!(parse_size("8 GiB"), Ok(8 << 30));
        assert_eq!(parse_size("17"), Ok(17));
        assert!(parse_size("M").is_err());
        assert!(parse_size("12X").is_err());
        assert!(parse_size("99999999999T").is_err());
    }
}
