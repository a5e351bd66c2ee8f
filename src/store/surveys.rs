//! Surveys and their files.

use super::digest::Digest;
use super::error::StoreError;
use super::ids::{SurveyId, UploadId};
use super::listing::{Created, Page};
use super::survey_path::SurveyPath;
use heliomap_mapping::reconstruction::PhotoFacts;
use heliomap_model::PlantId;
use jiff::Timestamp;

/// One flight over a plant: photos and what structure from motion made of them.
#[derive(Debug, Clone)]
pub struct Survey {
    pub seq: i64,
    pub id: SurveyId,
    pub plant: PlantId,
    pub name: String,
    pub created: Timestamp,
}

/// A file of a survey.
#[derive(Debug, Clone)]
pub struct FileRecord {
    pub path: SurveyPath,
    /// Bytes.
    pub size: u64,
    pub sha256: Digest,
    /// Width and height in pixels, where it is an image.
    pub size_px: Option<[u32; 2]>,
    /// Metadata of a photo.
    pub photo: Option<PhotoFacts>,
    /// The images of a readable reconstruction, sorted.
    pub shots: Option<Vec<String>>,
    pub stored: Timestamp,
}

/// The precondition on the existing file for a replacement.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Wanted {
    /// Some file.
    Anything,
    /// Nothing.
    Nothing,
    /// A file with one of these digests.
    OneOf(Vec<Digest>),
    /// Nothing, or a file with none of these digests.
    NoneOf(Vec<Digest>),
}

impl Wanted {
    /// Whether a file with this digest, or no file, meets the precondition.
    pub fn holds(&self, existing: Option<Digest>) -> bool {
        match (self, existing) {
            (Self::Anything, Some(_)) | (Self::Nothing, None) => true,
            (Self::OneOf(digests), Some(existing)) => digests.contains(&existing),
            (Self::NoneOf(digests), existing) => existing.is_none_or(|existing| !digests.contains(&existing)),
            _ => false,
        }
    }
}

/// Outcome of storing a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileWritten {
    Created,
    Replaced,
    /// The file had the same bytes already.
    Unchanged,
}

/// Outcome of deleting a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileDeleted {
    Deleted,
    /// There is no such file.
    Absent,
    /// The file does not meet the precondition.
    Other,
}

/// Surveys and their files.
#[async_trait::async_trait]
pub trait SurveyStore: Send + Sync + 'static {
    /// Creates a survey of a plant, or returns the existing one of that name.
    async fn create_survey(&self, plant: PlantId, name: &str, now: Timestamp) -> Result<Created<Survey>, StoreError>;
    /// One survey of a plant.
    async fn survey(&self, plant: PlantId, id: SurveyId) -> Result<Option<Survey>, StoreError>;
    /// A plant's surveys whose names begin with `prefix`, in order of creation.
    async fn surveys(&self, plant: PlantId, prefix: &str, page: Page) -> Result<Vec<Survey>, StoreError>;
    /// Gives a survey another name. Fails with [`StoreError::NameTaken`] where another of its plant has it, and
    /// [`StoreError::Gone`] where there is no such survey.
    async fn rename_survey(&self, id: SurveyId, name: &str) -> Result<Survey, StoreError>;
    /// Deletes a survey with its files, uploads and jobs; workers lose the leases of its jobs. Models that were made from it
    /// stay, with a warning. Returns its uploads, whose bytes may still exist; `None` where there was no such survey.
    async fn delete_survey(&self, id: SurveyId, now: Timestamp) -> Result<Option<Vec<UploadId>>, StoreError>;
    /// Deletes a file if it meets a precondition; models that were made from its survey get a warning that names it. A job
    /// that runs goes on with the files that it began with.
    async fn delete_file(
        &self,
        survey: SurveyId,
        path: &SurveyPath,
        wanted: Option<&Wanted>,
        now: Timestamp,
    ) -> Result<FileDeleted, StoreError>;
    /// Stores the records of files, all or none; a file at the same path is replaced. Returns one outcome per file, in order. The
    /// bytes must be reserved and stored before: [`StoreError::BeingFreed`] where they were deleted since.
    async fn put_files(&self, survey: SurveyId, files: &[FileRecord]) -> Result<Vec<FileWritten>, StoreError>;
    /// As [`Self::put_files`] for one file, if the existing file meets a precondition; `None` if not.
    async fn replace_file(
        &self,
        survey: SurveyId,
        file: &FileRecord,
        wanted: &Wanted,
    ) -> Result<Option<FileWritten>, StoreError>;
    /// A survey's files, sorted by path.
    async fn files(&self, survey: SurveyId) -> Result<Vec<FileRecord>, StoreError>;
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
    /// Paths of a survey's photos that have the same bytes as another one, with their digests; sorted.
    async fn photos_alike(&self, survey: SurveyId) -> Result<Vec<(Digest, SurveyPath)>, StoreError>;
    /// Paths of a survey's photos with these bytes, sorted, at most `limit`.
    async fn photos_of_digest(
        &self,
        survey: SurveyId,
        sha256: Digest,
        limit: u32,
    ) -> Result<Vec<SurveyPath>, StoreError>;
}
