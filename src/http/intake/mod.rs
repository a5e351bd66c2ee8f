//! What comes in: streamed to disk within bounds, then checked before it is stored.

pub mod archive;
pub mod content;
pub mod digest;
pub mod receive;

use super::error::{ApiError, Code};
use super::state::AppState;
use crate::plant::PlantId;
use crate::store::{FileRecord, FileWritten, StagedFile, SurveyId, SurveyPath};
use jiff::Timestamp;
use std::path::Path;

/// A file that came in, was checked, and is not stored yet.
pub struct Checked {
    pub path: SurveyPath,
    pub staged: StagedFile,
    /// Width and height in pixels, where it is an image.
    pub size_px: Option<[u32; 2]>,
}

/// Checks that a staged file holds what its place in the survey says.
pub async fn check(state: &AppState, path: SurveyPath, staged: StagedFile) -> Result<Checked, ApiError> {
    let limits = state.limits.clone();
    let work = tokio::task::spawn_blocking(move || {
        let size_px = content::check(&staged.path, &path, &limits)?;
        Ok(Checked { path, staged, size_px })
    });
    work.await.unwrap_or_else(|error| Err(ApiError::internal(&error)))
}

/// Stores files that were checked: first their bytes, then all rows at once.
pub async fn store(
    state: &AppState,
    plant: PlantId,
    survey: SurveyId,
    files: Vec<Checked>,
) -> Result<Vec<(FileRecord, FileWritten)>, ApiError> {
    // As exact as the store keeps it, so that every answer says the same.
    let now = Timestamp::now();
    let stored = Timestamp::from_millisecond(now.as_millisecond()).unwrap_or(now);
    let mut records = Vec::with_capacity(files.len());
    for Checked { path, staged, size_px } in files {
        records.push(FileRecord { path, size: staged.size, sha256: staged.sha256, size_px, stored });
        state.blobs.put_file(plant, staged).await?;
    }
    match state.store.put_files(survey, &records).await {
        Ok(written) => Ok(records.into_iter().zip(written).collect()),
        Err(error) => {
            // The plant went while its files came: they go too.
            if state.store.plant(plant).await?.is_none() {
                state.blobs.delete_plant(plant).await?;
            }
            Err(error.into())
        }
    }
}

/// A failure of the service's own disk.
pub fn disk(path: &Path, source: std::io::Error) -> ApiError {
    crate::store::StoreError::Io { action: "use the file", path: path.to_owned(), source }.into()
}

/// A file too large, by its name.
pub fn too_large(name: &str, limit: u64) -> ApiError {
    ApiError::new(
        Code::TooLarge,
        format!("{name} is larger than the limit of {limit} bytes; send a smaller file or ask for a higher limit"),
    )
}
