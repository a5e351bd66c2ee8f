//! Uploads that may be resumed.

use super::error::StoreError;
use super::ids::{SurveyId, UploadId};
use super::pieces::Piece;
use super::usage::Quotas;
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::time::Duration;
use uuid::Uuid;

/// An upload that may be resumed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Upload {
    pub id: UploadId,
    pub survey: SurveyId,
    /// Bytes of the whole file.
    pub length: u64,
    /// Bytes that are safe on disk.
    pub received: u64,
    /// Whether it is a part of a file that is concatenated later.
    pub partial: bool,
    /// Its parts as the client named them (`Upload-Concat`); left out in lists.
    pub parts: Option<String>,
    /// Metadata as the client sent it (`Upload-Metadata`).
    pub metadata: String,
    pub expires: Timestamp,
    /// Outcome of storing the whole file, JSON.
    pub outcome: Option<String>,
    /// The data folder that has its bytes, where several share the bucket ([`Blobs::home`](super::Blobs::home)).
    pub home: Option<Uuid>,
}

/// Limits for a new upload.
#[derive(Debug, Clone, Copy)]
pub struct UploadBounds {
    /// Quotas where the organisation has none of its own.
    pub quotas: Quotas,
    /// Maximum number of unfinished uploads of an organisation.
    pub open: u64,
    /// Whether its bytes may be stored already. Then stored bytes are not counted against the quota here; storing the file counts
    /// them.
    pub may_be_there: bool,
}

/// Uploads that may be resumed.
#[async_trait::async_trait]
pub trait UploadStore: Send + Sync + 'static {
    /// Creates an upload, within limits unless it is a concatenation of others, which it replaces. Fails with
    /// [`StoreError::OverQuota`] where its announced length does not fit, [`StoreError::TooManyUploads`] where there are too many.
    async fn create_upload(
        &self,
        upload: &Upload,
        bounds: Option<&UploadBounds>,
        now: Timestamp,
    ) -> Result<(), StoreError>;
    /// One upload to a survey, even if expired.
    async fn upload(&self, survey: SurveyId, id: UploadId) -> Result<Option<Upload>, StoreError>;
    /// A survey's uploads that are not expired, in order of their identifiers: at most `limit` of those after `after`.
    async fn uploads_of_survey(
        &self,
        survey: SurveyId,
        after: &str,
        limit: u32,
        now: Timestamp,
    ) -> Result<Vec<Upload>, StoreError>;
    /// Records how many bytes are safe, in which data folder and in which further pieces, and a new expiry; `false` where the
    /// upload was deleted or changed meanwhile.
    async fn upload_received(
        &self,
        upload: &Upload,
        received: u64,
        home: Option<Uuid>,
        pieces: &[Piece],
        expires: Timestamp,
    ) -> Result<bool, StoreError>;
    /// The recorded pieces, in order.
    async fn upload_pieces(&self, id: UploadId) -> Result<Vec<Piece>, StoreError>;
    /// Claims, or keeps, a complete upload for storing it, for `lease`; `false` where another process has it, it is stored, or it
    /// was deleted.
    async fn take_upload_end(
        &self,
        id: UploadId,
        token: Uuid,
        lease: Duration,
        now: Timestamp,
    ) -> Result<bool, StoreError>;
    /// Records the outcome of storing it, JSON; without one, another process may claim it.
    async fn end_upload(&self, id: UploadId, token: Uuid, outcome: Option<&str>) -> Result<(), StoreError>;
    /// Deletes an upload; `false` where there was none.
    async fn delete_upload(&self, survey: SurveyId, id: UploadId) -> Result<bool, StoreError>;
    /// Deletes expired uploads.
    async fn delete_expired_uploads(&self, now: Timestamp) -> Result<(), StoreError>;
    /// A plant's uploads.
    async fn uploads_of_plant(&self, plant: PlantId) -> Result<Vec<UploadId>, StoreError>;
    /// All uploads.
    async fn uploads(&self) -> Result<Vec<UploadId>, StoreError>;
}
