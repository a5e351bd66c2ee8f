//! What the service keeps: rows in a database behind one repository trait per aggregate, bytes in a blob store.
//!
//! A method of a repository is one atomic action of the domain: it happens as a whole or not at all, even where the process
//! dies in between. Methods and their statements (`backend/`) are written once for both databases; a database's own file
//! holds only what differs.

pub mod access;
pub mod blobs;
pub mod bucket;
mod connections;
pub mod digest;
pub mod error;
pub mod freeing;
pub mod ids;
pub mod jobs;
pub mod listing;
pub mod models;
pub mod name;
pub mod pieces;
pub mod plants;
pub mod postgres;
pub mod repository;
pub mod requests;
pub mod schema;
pub mod secret;
mod server_id;
pub mod sqlite;
pub mod survey_path;
pub mod surveys;
pub mod tasks;
pub mod uploads;
pub mod usage;
pub mod webhooks;

pub use access::{AccessStore, ApiKey, AuditEntry, NewKey, Organisation, Scope, SecretRecord};
pub use blobs::{Blobs, StagedFile, keep_free};
pub use bucket::Bucket;
pub use digest::Digest;
pub use error::StoreError;
pub use ids::{DeliveryId, JobId, KeyId, OrganisationId, SurveyId, UploadId, WebhookId};
pub use jobs::{
    Cancelled, Checkpoint, Claim, Completed, Ending, Enqueued, Heartbeat, Job, JobRequest, JobState, JobStore,
    Progress, Queue,
};
pub use listing::{Created, Page, TimeSpan};
pub use models::{Feature, FeatureQuery, GeoBox, LayerInfo, Model, ModelStore, NewFeature, NewLayer, NewModel};
pub use pieces::Piece;
pub use plants::{Plant, PlantStore};
pub use postgres::PostgresStore;
pub use repository::{Pool, Store};
pub use requests::RequestStore;
pub use secret::Secret;
pub use sqlite::SqliteStore;
pub use survey_path::{Content, FileKind, ImageName, InvalidPath, SurveyPath, looks_like_photo};
pub use surveys::{FileDeleted, FileRecord, FileWritten, Survey, SurveyStore, Wanted};
pub use tasks::{GivenBack, ImageTask, OwnTask, TaskClaim, TaskStore};
pub use uploads::{Upload, UploadBounds, UploadStore};
pub use usage::{BlobRecord, Quotas, UnusedBlob, Usage, UsageStore};
pub use webhooks::{Delivery, DeliveryClaim, DeliveryState, NewWebhook, Sent, SigningSecret, Webhook, WebhookStore};
