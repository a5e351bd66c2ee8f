//! A whole file is checked and stored.

use super::Outcome;
use super::place::Place;
use crate::http::AppState;
use crate::http::error::ApiError;
use crate::http::intake::{self, disk};
use crate::http::uploads::{self, UploadedFile};
use crate::plant::PlantId;
use crate::store::{Digest, StagedFile, Upload};
use uuid::Uuid;

/// Checks a whole file and stores it in its survey, once; a part waits for the others.
pub(super) async fn finish(state: &AppState, plant: PlantId, upload: &Upload) -> Result<(), ApiError> {
    if upload.partial || upload.outcome.is_some() {
        return Ok(());
    }
    let stored = store_whole(state, plant, upload).await;
    let outcome = match &stored {
        Ok(files) => Outcome { files: files.iter().map(|file| serde_json::json!(file)).collect(), problem: None },
        // The service failed, not the file: it is tried again when the client asks how the upload stands.
        Err(problem) if problem.code.parts().0.is_server_error() => return stored.map(drop),
        Err(problem) => Outcome { files: Vec::new(), problem: Some(problem.document()) },
    };
    state.store.end_upload(upload.id, &serde_json::json!(outcome).to_string()).await?;
    state.blobs.drop_upload(upload.id).await;
    stored.map(drop)
}

async fn store_whole(state: &AppState, plant: PlantId, upload: &Upload) -> Result<Vec<UploadedFile>, ApiError> {
    let place = Place::of(&upload.metadata)?;
    let (source, size) = (state.blobs.upload_file(upload.id), upload.length);
    let link = state.blobs.staging().join(format!("whole-{}", Uuid::new_v4().simple()));
    let path = source.clone();
    // A link is checked and stored: a crash before the end is noted leaves the upload as it is.
    let staged = tokio::task::spawn_blocking(move || {
        std::fs::hard_link(&source, &link)?;
        let path = tempfile::TempPath::try_from_path(link)?;
        Ok::<_, std::io::Error>(StagedFile { sha256: Digest::of_file(&path)?, path, size })
    });
    let staged = staged.await.map_err(|error| ApiError::internal(&error))?.map_err(|error| disk(&path, error))?;
    match place {
        Place::Archive => Ok(uploads::store_archive(state, plant, upload.survey, staged).await?.files),
        Place::File(path) => {
            let checked = intake::check(state, path, staged).await?;
            let stored = intake::store(state, plant, upload.survey, vec![checked], None).await?;
            Ok(stored.into_iter().map(uploads::uploaded).collect())
        }
    }
}
