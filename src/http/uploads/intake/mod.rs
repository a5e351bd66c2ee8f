//! What comes in: streamed to disk within bounds, then checked before it is stored.

pub mod archive;
pub mod content;
pub mod digest;
pub mod receive;

use crate::http::error::{ApiError, Code};
use crate::http::middleware::conditional;
use crate::http::state::AppState;
use crate::store::freeing::free_abandoned;
use crate::store::{Digest, FileKind, FileRecord, FileWritten, StagedFile, StoreError, SurveyId, SurveyPath, Wanted};
use content::Found;
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::path::Path;
use std::time::{Duration, Instant};

/// A file that came in, was checked, and is not stored yet.
pub struct Checked {
    pub path: SurveyPath,
    pub staged: StagedFile,
    pub found: Found,
}

/// A file that was stored.
pub struct Stored {
    pub record: FileRecord,
    pub written: FileWritten,
    /// Other photos of the survey with the same bytes, the first few.
    pub twins: Vec<SurveyPath>,
}

/// How many photos with the same bytes are named.
pub const MAX_TWINS: u32 = 5;

/// How long an upload waits while the bytes that it brings again are being deleted, which takes a moment, and how often it
/// looks.
const WAIT_FOR_FREEING: Duration = Duration::from_secs(5);
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Checks that a staged file of a plant holds what its place in the survey says.
pub async fn check(
    state: &AppState,
    plant: PlantId,
    path: SurveyPath,
    staged: StagedFile,
) -> Result<Checked, ApiError> {
    let limits = state.limits.clone();
    // A few at once, so that many that come together take neither all memory nor all cores.
    let turn = state.checking.take(state.require_plant(plant).await?.organisation).await;
    let work = tokio::task::spawn_blocking(move || {
        let found = content::check(&staged.path, &path, &limits)?;
        drop(turn);
        Ok(Checked { path, staged, found })
    });
    work.await.unwrap_or_else(|error| Err(ApiError::internal(&error)))
}

/// Stores files that were checked: first their bytes, then all rows at once. A single one may be wanted only where what is at
/// its place is so.
pub async fn store(
    state: &AppState,
    plant: PlantId,
    survey: SurveyId,
    files: Vec<Checked>,
    wanted: Option<&Wanted>,
) -> Result<Vec<Stored>, ApiError> {
    // As exact as the store keeps it, so that every answer says the same.
    let now = Timestamp::now();
    let stored = Timestamp::from_millisecond(now.as_millisecond()).unwrap_or(now);
    let blobs: Vec<_> = files.iter().map(|file| (file.staged.sha256, file.staged.size)).collect();
    reserve(state, plant, &blobs).await?;
    let mut records = Vec::with_capacity(files.len());
    for Checked { path, staged, found } in files {
        let Found { size_px, photo, shots } = found;
        records.push(FileRecord { path, size: staged.size, sha256: staged.sha256, size_px, photo, shots, stored });
        state.blobs.put_file(plant, staged).await?;
    }
    let written = match (wanted, records.as_slice()) {
        (Some(wanted), [record]) => match state.store.replace_file(survey, record, wanted).await {
            Ok(Some(written)) => Ok(vec![written]),
            Ok(None) => return Err(conditional::failed()),
            Err(error) => Err(error),
        },
        (_, records) => state.store.put_files(survey, records).await,
    };
    let written = match written {
        Ok(written) => written,
        Err(error) => {
            // The plant went while its files came: they go too.
            if state.store.plant(plant).await?.is_none() {
                state.blobs.delete_plant(plant).await?;
            }
            return Err(error.into());
        }
    };
    let mut stored = Vec::with_capacity(records.len());
    for (record, written) in records.into_iter().zip(written) {
        let twins = twins(state, survey, &record).await?;
        stored.push(Stored { record, written, twins });
    }
    Ok(stored)
}

/// Counts bytes that are about to be stored.
async fn reserve(state: &AppState, plant: PlantId, blobs: &[(Digest, u64)]) -> Result<(), StoreError> {
    let (begun, mut helped) = (Instant::now(), false);
    loop {
        match state.store.reserve_bytes(plant, blobs, state.limits.quotas(), Timestamp::now()).await {
            Err(StoreError::BeingFreed { .. }) if !helped => {
                // Whoever deletes them may be dead.
                helped = true;
                free_abandoned(&*state.store, &state.blobs).await?;
            }
            Err(StoreError::BeingFreed { .. }) if begun.elapsed() < WAIT_FOR_FREEING => {
                tokio::time::sleep(LOOK_EVERY).await;
            }
            other => return other,
        }
    }
}

/// Other photos of the survey with the bytes of a photo, the first few.
async fn twins(state: &AppState, survey: SurveyId, file: &FileRecord) -> Result<Vec<SurveyPath>, ApiError> {
    if file.path.kind() != FileKind::Image {
        return Ok(Vec::new());
    }
    let mut twins = state.store.photos_of_digest(survey, file.sha256, MAX_TWINS + 1).await?;
    twins.retain(|path| *path != file.path);
    twins.truncate(MAX_TWINS as usize);
    Ok(twins)
}

/// A failure of the service's own disk.
pub fn disk(path: &Path, source: std::io::Error) -> ApiError {
    StoreError::Io { action: "use the file", path: path.to_owned(), source }.into()
}

/// A file too large, by its name.
pub fn too_large(name: &str, limit: u64) -> ApiError {
    ApiError::new(
        Code::TooLarge,
        format!("{name} is larger than the limit of {limit} bytes; send a smaller file or ask for a higher limit"),
    )
}
