//! Uploads that may be resumed.

use super::records::row_id;
use super::usage::Quotas;
use super::{Piece, StoreError, SurveyId};
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::fmt;
use std::time::Duration;
use uuid::Uuid;

row_id!(
    /// Identifies an upload that may be resumed.
    UploadId
);

/// An upload that may be resumed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Upload {
    pub id: UploadId,
    pub survey: SurveyId,
    /// Bytes of the whole file.
    pub length: u64,
    /// Bytes that are safe on disk.
    pub received: u64,
    /// Whether it is a part of a file that is put together later.
    pub partial: bool,
    /// From what it was put together, as the client told it; lists leave it out.
    pub parts: Option<String>,
    /// What the client told of the file, as it told it.
    pub metadata: String,
    pub expires: Timestamp,
    /// What became of the whole file, JSON.
    pub outcome: Option<String>,
    /// The data folder that has its bytes, where others share the bucket ([`Blobs::home`](super::Blobs::home)).
    pub home: Option<Uuid>,
}

/// What an upload that begins must keep to.
#[derive(Debug, Clone, Copy)]
pub struct UploadBounds {
    /// What holds for what was not said of the organisation alone.
    pub quotas: Quotas,
    /// Most unfinished uploads of an organisation.
    pub open: u64,
    /// Whether its bytes may be in the survey already. Then they fit where they would if nothing was kept: storing them
    /// tells whether they count.
    pub may_be_there: bool,
}

/// Uploads that may be resumed.
#[async_trait::async_trait]
pub trait UploadStore: Send + Sync + 'static {
    /// Notes an upload to come, within bounds unless it was put together from others, which it replaces:
    /// [`StoreError::OverQuota`] where what it announces does not fit, [`StoreError::TooManyUploads`] where there are too many.
    async fn create_upload(
        &self,
        upload: &Upload,
        bounds: Option<&UploadBounds>,
        now: Timestamp,
    ) -> Result<(), StoreError>;
    /// One upload to a survey, expired ones included.
    async fn upload(&self, survey: SurveyId, id: UploadId) -> Result<Option<Upload>, StoreError>;
    /// A survey's uploads that are not expired, in the order of their identifiers: at most `limit` of those after a text.
    async fn uploads_of_survey(
        &self,
        survey: SurveyId,
        after: &str,
        limit: u32,
        now: Timestamp,
    ) -> Result<Vec<Upload>, StoreError>;
    /// Notes how many bytes are safe, in which data folder and in which further pieces, and a new end of its life; `false`
    /// where the upload is gone, or is not as it was told.
    async fn upload_received(
        &self,
        upload: &Upload,
        received: u64,
        home: Option<Uuid>,
        pieces: &[Piece],
        expires: Timestamp,
    ) -> Result<bool, StoreError>;
    /// The pieces that count, in order.
    async fn upload_pieces(&self, id: UploadId) -> Result<Vec<Piece>, StoreError>;
    /// Takes a whole file that nobody else is storing, or goes on to have it, until `lease` is over; `false` where somebody
    /// is, where it is known what became of it, or where it is gone.
    async fn take_upload_end(
        &self,
        id: UploadId,
        token: Uuid,
        lease: Duration,
        now: Timestamp,
    ) -> Result<bool, StoreError>;
    /// Notes what became of the whole file, JSON, by whoever has it; where nothing is to be noted, others may take it.
    async fn end_upload(&self, id: UploadId, token: Uuid, outcome: Option<&str>) -> Result<(), StoreError>;
    /// Forgets an upload; whether there was one.
    async fn delete_upload(&self, survey: SurveyId, id: UploadId) -> Result<bool, StoreError>;
    /// Forgets uploads whose time is over.
    async fn delete_expired_uploads(&self, now: Timestamp) -> Result<(), StoreError>;
    /// A plant's uploads.
    async fn uploads_of_plant(&self, plant: PlantId) -> Result<Vec<UploadId>, StoreError>;
    /// All uploads that are known.
    async fn uploads(&self) -> Result<Vec<UploadId>, StoreError>;
}
