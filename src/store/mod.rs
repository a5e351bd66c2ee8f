//! What the service remembers: rows in a database behind one trait, bytes in a blob store.
//!
//! A method of [`Store`] is one atomic action of the domain: it happens as a whole or not at all, whoever dies in
//! between. Statements (`sql.rs`) and methods (`backend/`) are written once; a database's own file holds what differs.

pub mod access;
pub mod blobs;
pub mod bucket;
pub mod freeing;
pub mod name;
pub mod pieces;
pub mod postgres;
pub mod records;
pub mod requests;
pub mod schema;
pub mod secret;
pub mod sqlite;
pub mod survey_path;
pub mod tasks;
pub mod uploads;
pub mod usage;
pub mod webhooks;

mod sql;

pub use access::{AccessStore, ApiKey, AuditEntry, KeyId, NewKey, Organisation, OrganisationId, Scope, SecretRecord};
pub use blobs::{Blobs, Digest, StagedFile, keep_free};
pub use bucket::Bucket;
pub use pieces::Piece;
pub use postgres::PostgresStore;
pub use records::{
    BlobRecord, Cancelled, Checkpoint, Claim, Completed, Created, Ending, Enqueued, Feature, FeatureQuery, FileRecord,
    FileWritten, GeoBox, Heartbeat, Job, JobId, JobRequest, JobState, LayerInfo, Model, NewFeature, NewLayer, NewModel,
    Page, Plant, Pool, Progress, Queue, Survey, SurveyId, TimeSpan, Wanted,
};
pub use requests::RequestStore;
pub use secret::Secret;
pub use sqlite::SqliteStore;
pub use survey_path::{Content, FileKind, ImageName, InvalidPath, SurveyPath};
pub use tasks::{GivenBack, ImageTask, OwnTask, TaskClaim, TaskStore};

pub use uploads::{Upload, UploadBounds, UploadId, UploadStore};
pub use usage::{Quotas, UnusedBlob, Usage, UsageStore};
pub use webhooks::{
    Delivery, DeliveryClaim, DeliveryId, DeliveryState, NewWebhook, Sent, SigningSecret, Webhook, WebhookId,
    WebhookStore,
};

use heliomap_model::{Layer, ModuleId, PlantId};
use jiff::Timestamp;
use std::time::Duration;
use tokio::sync::Notify;

/// Why the store could not do as told.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The row that a new row belongs to was deleted meanwhile.
    #[error("the {what} is gone")]
    Gone { what: &'static str },
    /// The same bytes are just being deleted, because nothing named them any more: they may come again in a moment.
    #[error("the blob {sha256} is being deleted")]
    BeingFreed { sha256: Digest },
    /// The organisation may not keep so much.
    #[error("the organisation keeps {used} of the {quota} {what} that it may keep")]
    OverQuota { what: &'static str, used: u64, quota: u64 },
    /// The organisation has as many unfinished uploads as it may.
    #[error("the organisation has {open} unfinished uploads, and may have {most}")]
    TooManyUploads { open: u64, most: u64 },
    /// The database failed.
    #[error("database: {0}")]
    Database(#[from] sqlx::Error),
    /// The database did not answer in time.
    #[error("the database does not answer")]
    Silent,
    /// The database's schema could not be brought up to date.
    #[error("database schema: {0}")]
    Migration(#[from] sqlx::migrate::MigrateError),
    /// The blob store failed.
    #[error("blob store: {0}")]
    Blob(#[from] object_store::Error),
    /// A blob is not what was stored.
    #[error("the blob {sha256} of plant {plant} is damaged: it holds other bytes; put it back from a backup")]
    Damaged { plant: PlantId, sha256: Digest },
    /// The file system failed.
    #[error("{action} {path}: {source}")]
    Io { action: &'static str, path: std::path::PathBuf, source: std::io::Error },
    /// A row holds what no version of this program writes.
    #[error("the {what} holds `{value}`, which is none")]
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

/// The rows. Absence is `Ok(None)`; the time comes in from the caller.
#[async_trait::async_trait]
pub trait Store: AccessStore + UploadStore + RequestStore + TaskStore + WebhookStore + UsageStore {
    /// Fails where the database does not answer.
    async fn ping(&self) -> Result<(), StoreError>;
    /// Rings, for as long as it is polled, when any process has queued a job, offered images or left work undone. A database
    /// that tells nothing, or just now does not, never rings: whoever waits for work looks for it now and then, too.
    async fn ring_for_work(&self, bell: &Notify);

    /// Creates an organisation's plant, or finds the one of that name. [`StoreError::OverQuota`] where it has as many as it
    /// may; `defaults` holds for what was not said of the organisation alone.
    async fn create_plant(
        &self,
        organisation: OrganisationId,
        name: &str,
        defaults: Quotas,
        now: Timestamp,
    ) -> Result<Created<Plant>, StoreError>;
    /// One plant, whoever owns it.
    async fn plant(&self, id: PlantId) -> Result<Option<Plant>, StoreError>;
    /// An organisation's plants, or those of them that are in a list, whose names begin so, in the order of their creation.
    async fn plants(
        &self,
        organisation: OrganisationId,
        only: Option<&[PlantId]>,
        prefix: &str,
        page: Page,
    ) -> Result<Vec<Plant>, StoreError>;
    /// Deletes a plant with every row that belongs to it, and notes that its blobs are to go; whether there was one. Its
    /// workers lose their jobs.
    async fn delete_plant(&self, id: PlantId, now: Timestamp) -> Result<bool, StoreError>;
    /// Plants that were deleted and whose blobs may still be there.
    async fn deleted_plants(&self) -> Result<Vec<PlantId>, StoreError>;
    /// Forgets the plants that were deleted before a time.
    async fn forget_deleted_plants(&self, before: Timestamp) -> Result<(), StoreError>;

    /// Creates a survey of a plant, or finds the one of that name.
    async fn create_survey(&self, plant: PlantId, name: &str, now: Timestamp) -> Result<Created<Survey>, StoreError>;
    /// One survey of a plant.
    async fn survey(&self, plant: PlantId, id: SurveyId) -> Result<Option<Survey>, StoreError>;
    /// A plant's surveys whose names begin so, in the order of their creation.
    async fn surveys(&self, plant: PlantId, prefix: &str, page: Page) -> Result<Vec<Survey>, StoreError>;

    /// Puts files into a survey, all or none; a file at the same path is replaced. One answer per file, in order. Their bytes
    /// must be reserved, and stored: [`StoreError::BeingFreed`] where nothing named them for so long that they went.
    async fn put_files(&self, survey: SurveyId, files: &[FileRecord]) -> Result<Vec<FileWritten>, StoreError>;
    /// As [`Self::put_files`] of one file, where what is at its path is as wanted; `None` where it is not.
    async fn replace_file(
        &self,
        survey: SurveyId,
        file: &FileRecord,
        wanted: &Wanted,
    ) -> Result<Option<FileWritten>, StoreError>;
    /// A survey's files, sorted by path.
    async fn files(&self, survey: SurveyId) -> Result<Vec<FileRecord>, StoreError>;

    /// The blobs that files and models name, each plant's once, by plant and digest: at most `limit` of those after one.
    async fn blobs(&self, after: Option<(PlantId, Digest)>, limit: u32) -> Result<Vec<BlobRecord>, StoreError>;
    /// One file of a survey.
    async fn file(&self, survey: SurveyId, path: &SurveyPath) -> Result<Option<FileRecord>, StoreError>;
    /// A survey's photos whose names begin with a prefix, sorted by path: at most `limit` of those after a text.
    async fn photos(
        &self,
        survey: SurveyId,
        prefix: &str,
        after: &str,
        limit: u32,
    ) -> Result<Vec<FileRecord>, StoreError>;
    /// Where those of a survey's photos are whose bytes another one has, too, each with their digest; sorted.
    async fn photos_alike(&self, survey: SurveyId) -> Result<Vec<(Digest, SurveyPath)>, StoreError>;
    /// Where a survey's photos with these bytes are, sorted, at most `limit`.
    async fn photos_of_digest(
        &self,
        survey: SurveyId,
        sha256: Digest,
        limit: u32,
    ) -> Result<Vec<SurveyPath>, StoreError>;

    /// Queues a mapping of a survey, or finds its unfinished job.
    async fn enqueue_job(&self, request: &JobRequest, now: Timestamp) -> Result<Enqueued, StoreError>;
    /// One job of a plant.
    async fn job(&self, plant: PlantId, id: JobId) -> Result<Option<Job>, StoreError>;
    /// A plant's jobs, or those of one survey, or in one state, the newest first.
    async fn jobs(
        &self,
        plant: PlantId,
        survey: Option<SurveyId>,
        state: Option<JobState>,
        page: Page,
    ) -> Result<Vec<Job>, StoreError>;
    /// Cancels a queued job at once, asks a running one to stop, leaves a finished one.
    async fn cancel_job(&self, plant: PlantId, id: JobId, now: Timestamp) -> Result<Option<Cancelled>, StoreError>;

    /// How the queue stands.
    async fn queue(&self, now: Timestamp) -> Result<Queue, StoreError>;
    /// The connections of this process.
    fn pools(&self) -> Vec<Pool>;

    /// Takes the job of the highest priority that may run, of these the oldest: queued and due, or abandoned by its
    /// worker; of a plant none of whose jobs runs. Ends jobs that were abandoned too often. The attempt is counted here,
    /// so that a job that kills its worker does not run for ever.
    async fn claim_job(&self, worker: &str, lease: Duration, now: Timestamp) -> Result<Option<Claim>, StoreError>;
    /// Extends the lease of a claimed job and records its progress.
    async fn heartbeat(
        &self,
        claim: &Claim,
        progress: Option<Progress>,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat, StoreError>;
    /// Keeps what a claimed job has found so far, for input, options and program with this fingerprint; `false` where the
    /// claim was lost. A job that got somewhere has all its attempts again.
    async fn checkpoint(&self, claim: &Claim, fingerprint: &str, found: &[Checkpoint]) -> Result<bool, StoreError>;
    /// What an unfinished job has found so far under this fingerprint.
    async fn checkpoints(&self, job: JobId, fingerprint: &str) -> Result<Vec<Checkpoint>, StoreError>;
    /// What each stage of the last job took, JSON, whoever's job that was.
    async fn last_stage_ms(&self) -> Result<Option<String>, StoreError>;
    /// Ends a claimed job with its model: the job's end and the model appear together.
    async fn complete_job(&self, claim: &Claim, model: &NewModel, now: Timestamp) -> Result<Completed, StoreError>;
    /// Ends a claimed job without a model, or puts it back; `false` where the claim was lost.
    async fn end_job(&self, claim: &Claim, ending: &Ending, now: Timestamp) -> Result<bool, StoreError>;

    /// A plant's models, the newest first.
    async fn models(&self, plant: PlantId, page: Page) -> Result<Vec<Model>, StoreError>;
    /// One model of a plant; the newest where no version is given.
    async fn model(&self, plant: PlantId, version: Option<u32>) -> Result<Option<Model>, StoreError>;
    /// What a layer of a model holds.
    async fn layer(&self, model: &Model, layer: Layer) -> Result<Option<LayerInfo>, StoreError>;
    /// Features of a layer in the order of the model.
    async fn features(&self, layer: &LayerInfo, query: FeatureQuery) -> Result<Vec<Feature>, StoreError>;
    /// One module of a model.
    async fn module(&self, model: &Model, id: ModuleId) -> Result<Option<String>, StoreError>;
    /// The newest version of a plant's model that holds a module.
    async fn module_last_seen(&self, plant: PlantId, id: ModuleId) -> Result<Option<u32>, StoreError>;
}
