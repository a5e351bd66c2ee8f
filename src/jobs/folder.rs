//! The folder of a job: the survey's files, laid out as OpenSfM leaves them.

use super::AttemptError;
use crate::plant::PlantId;
use crate::store::{Blobs, FileRecord};
use tempfile::TempDir;

/// Lays out a survey's files in a new temporary folder, as hard links where the file system has them.
pub async fn lay_out(blobs: &Blobs, plant: PlantId, files: &[FileRecord]) -> Result<TempDir, AttemptError> {
    let folder = tempfile::Builder::new().prefix("job-").tempdir_in(blobs.staging())?;
    for file in files {
        let target = folder.path().join(file.path.as_str());
        if let Some(parent) = target.parent() {
            tokio::fs::create_dir_all(parent).await?;
        }
        blobs.place(plant, file.sha256, &target).await?;
    }
    Ok(folder)
}
