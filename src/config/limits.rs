//! What one client, and one organisation, may use.

use super::units::{parse_megapixels, parse_seconds, parse_size};
use crate::store::Quotas;
use clap::Args;
use std::time::Duration;

/// What one client may use. In sizes, K, M, G and T are powers of 1024.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Limits")]
pub struct Limits {
    /// Largest image file.
    #[arg(long, env = "HELIOMAP_MAX_IMAGE_SIZE", default_value = "256M", value_parser = parse_size, value_name = "SIZE")]
    pub max_image_size: u64,
    /// Largest image, in millions of pixels; checked before an image is decoded.
    #[arg(long, env = "HELIOMAP_MAX_IMAGE_MEGAPIXELS", default_value = "100", value_parser = parse_megapixels, value_name = "MP")]
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
    /// How many attempts in a row may make no progress before a job fails.
    #[arg(long, env = "HELIOMAP_MAX_ATTEMPTS", default_value_t = 3, value_name = "COUNT")]
    pub max_attempts: u32,
    /// How long an upload may stall, and how long any other request may take.
    #[arg(long, env = "HELIOMAP_REQUEST_TIMEOUT", default_value = "30s", value_parser = parse_seconds, value_name = "DURATION")]
    pub request_timeout: Duration,
    /// Requests per second of one key, on average; bursts may be twice as many.
    #[arg(long, env = "HELIOMAP_MAX_REQUESTS_PER_SECOND", default_value_t = 300, value_parser = clap::value_parser!(u32).range(1..), value_name = "COUNT")]
    pub max_requests_per_second: u32,
    /// Requests per minute without a valid key that one address may send.
    #[arg(long, env = "HELIOMAP_MAX_FAILED_LOGINS_PER_MINUTE", default_value_t = 300, value_parser = clap::value_parser!(u32).range(1..), value_name = "COUNT")]
    pub max_failed_logins_per_minute: u32,
    /// Most connections at once; more wait.
    #[arg(long, env = "HELIOMAP_MAX_CONNECTIONS", default_value_t = 1024, value_name = "COUNT")]
    pub max_connections: usize,
    /// Most connections from one address at once (from one /64 with IPv6); more are closed. Ignored with
    /// `--behind-proxy`, where all connections come from the proxy.
    #[arg(long, env = "HELIOMAP_MAX_CONNECTIONS_PER_ADDRESS", default_value_t = 256, value_name = "COUNT")]
    pub max_connections_per_address: usize,
    /// Most unfinished resumable uploads of an organisation.
    #[arg(long, env = "HELIOMAP_MAX_UPLOADS", default_value_t = 10_000, value_name = "COUNT")]
    pub max_uploads: u64,
    /// Free space of the data folder's disk that uploads leave to running jobs.
    #[arg(long, env = "HELIOMAP_DISK_RESERVE", default_value = "1G", value_parser = parse_size, value_name = "SIZE")]
    pub disk_reserve: u64,
    /// Most bytes of files and models that an organisation may keep; unlimited if absent. `heliomap organisations quota` sets
    /// it for one organisation.
    #[arg(long, env = "HELIOMAP_QUOTA_BYTES", value_parser = parse_size, value_name = "SIZE")]
    pub quota_bytes: Option<u64>,
    /// Most plants that an organisation may have; unlimited if absent. `heliomap organisations quota` sets it for one
    /// organisation.
    #[arg(long, env = "HELIOMAP_QUOTA_PLANTS", value_name = "COUNT")]
    pub quota_plants: Option<u64>,
}

impl Limits {
    /// The quotas of organisations without quotas of their own.
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
            max_connections_per_address: 256,
            max_uploads: 10_000,
            disk_reserve: 1 << 30,
            quota_bytes: None,
            quota_plants: None,
        }
    }
}
