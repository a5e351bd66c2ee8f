//! Why the store could not do what was asked of it.

use super::digest::Digest;
use heliomap_model::PlantId;
use sqlx::migrate::MigrateError;

/// Why the store failed.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The parent of a new row was deleted meanwhile.
    #[error("the {what} was deleted")]
    Gone { what: &'static str },
    /// The same bytes are being deleted, because no row refers to them: a retry in a moment succeeds.
    #[error("the blob {sha256} is being deleted")]
    BeingFreed { sha256: Digest },
    /// Another has the name.
    #[error("the name is taken")]
    NameTaken,
    /// A quota of the organisation would be exceeded.
    #[error("quota exceeded: the organisation uses {used} of {quota} {what}")]
    OverQuota { what: &'static str, used: u64, quota: u64 },
    /// The organisation has the maximum number of unfinished uploads.
    #[error("too many uploads: the organisation has {open} of at most {max} unfinished uploads")]
    TooManyUploads { open: u64, max: u64 },
    /// The database failed.
    #[error("database: {0}")]
    Database(#[from] sqlx::Error),
    /// The database did not answer in time.
    #[error("the database does not answer")]
    Silent,
    /// The database's schema could not be brought up to date.
    #[error("database schema: {0}")]
    Migration(MigrateError),
    /// The database's schema has a change that this program does not know.
    #[error(
        "a newer version of heliomap has upgraded the database (schema change {change}), which this version neither reads \
         nor writes: upgrade this program as well"
    )]
    NewerSchema { change: i64 },
    /// The blob store failed.
    #[error("blob store: {0}")]
    Blob(#[from] object_store::Error),
    /// The bytes of a blob do not match its digest.
    #[error("the blob {sha256} of plant {plant} is damaged: its bytes do not match; restore it from a backup")]
    Damaged { plant: PlantId, sha256: Digest },
    /// The file system failed.
    #[error("{action} {path}: {source}")]
    Io { action: &'static str, path: std::path::PathBuf, source: std::io::Error },
    /// A row holds a value that no version of this program writes.
    #[error("invalid value in the database: {what} is `{value}`")]
    Corrupt { what: &'static str, value: String },
}

impl StoreError {
    /// Whether the disk is full.
    pub fn is_full(&self) -> bool {
        use std::io::ErrorKind::{QuotaExceeded, StorageFull};
        let full = |error: &std::io::Error| matches!(error.kind(), StorageFull | QuotaExceeded);
        match self {
            Self::Io { source, .. } => full(source),
            // SQLITE_FULL, and Postgres' disk_full.
            Self::Database(sqlx::Error::Database(error)) => matches!(error.code().as_deref(), Some("13" | "53100")),
            _ => false,
        }
    }
}

impl From<MigrateError> for StoreError {
    fn from(error: MigrateError) -> Self {
        match error {
            MigrateError::VersionMissing(change) => Self::NewerSchema { change },
            other => Self::Migration(other),
        }
    }
}
