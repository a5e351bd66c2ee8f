//! The folder of a job: the survey's files, laid out as OpenSfM leaves them.

use super::AttemptError;
use crate::plant::PlantId;
use crate::store::{Blobs, FileRecord};
use futures::{StreamExt, TryStreamExt, stream};
use tempfile::TempDir;

/// Files that come from a bucket at once.
const FILES_AT_ONCE: usize = 8;

/// Lays out a survey's files in a new temporary folder, as hard links where the file system has them.
pub async fn lay_out(blobs: &Blobs, plant: PlantId, files: &[FileRecord]) -> Result<TempDir, AttemptError> {
    let folder = tempfile::Builder::new().prefix("job-").tempdir_in(blobs.staging())?;
    let places: Vec<_> = files.iter().map(|file| (folder.path().join(file.path.as_str()), file.sha256)).collect();
    let placed = stream::iter(places).map(|(target, sha256)| async move {
        if let Some(parent) = target.parent() {
            tokio::fs::create_dir_all(parent).await?;
        }
        Ok::<_, AttemptError>(blobs.place(plant, sha256, &target).await?)
    });
    placed.buffer_unordered(FILES_AT_ONCE).try_collect::<()>().await?;
    Ok(folder)
}
