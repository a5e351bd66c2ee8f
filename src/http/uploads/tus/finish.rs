//! A whole file is checked and stored.

use super::Outcome;
use super::place::Place;
use crate::http::controllers::files::{self, UploadedFile};
use crate::http::error::{ApiError, Code};
use crate::http::state::AppState;
use crate::http::uploads::intake::{self, disk};
use crate::store::{Digest, StagedFile, Upload, UploadId};
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::convert::Infallible;
use std::time::Duration;
use uuid::Uuid;

/// How long after a server fell silent another may store the whole file.
const LEASE: Duration = Duration::from_secs(10);

/// Checks a whole file and stores it in its survey, once; a part waits for the others.
pub(super) async fn finish(state: &AppState, plant: PlantId, upload: &Upload) -> Result<(), ApiError> {
    if upload.partial || upload.outcome.is_some() {
        return Ok(());
    }
    let token = Uuid::new_v4();
    if !state.store.take_upload_end(upload.id, token, LEASE, Timestamp::now()).await? {
        let busy = ApiError::new(Code::UploadBusy, "the whole file is just being stored; ask again how it stands");
        return Err(busy.retry_after(2));
    }
    let stored = tokio::select! {
        stored = store_whole(state, plant, upload) => stored,
        never = keep_taken(state, upload.id, token) => match never {},
    };
    let outcome = match &stored {
        Ok(files) => Outcome { files: files.iter().map(|file| serde_json::json!(file)).collect(), problem: None },
        // The service failed, not the file: it is tried again when the client asks how the upload stands.
        Err(problem) if problem.code.parts().0.is_server_error() => {
            state.store.end_upload(upload.id, token, None).await?;
            return stored.map(drop);
        }
        Err(problem) => Outcome { files: Vec::new(), problem: Some(problem.document()) },
    };
    state.store.end_upload(upload.id, token, Some(&serde_json::json!(outcome).to_string())).await?;
    state.blobs.drop_upload(upload.id).await;
    stored.map(drop)
}

/// Goes on to have a file that is being stored, for as long as it is polled: no other server stores it, too.
async fn keep_taken(state: &AppState, id: UploadId, token: Uuid) -> Infallible {
    loop {
        tokio::time::sleep(LEASE / 4).await;
        if let Err(error) = state.store.take_upload_end(id, token, LEASE, Timestamp::now()).await {
            tracing::warn!(%error, upload = %id, "an upload that is being stored may be taken by another server");
        }
    }
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
        Place::Archive => Ok(files::store_archive(state, plant, upload.survey, staged).await?.files),
        Place::File(path) => {
            let checked = intake::check(state, plant, path, staged).await?;
            let stored = intake::store(state, plant, upload.survey, vec![checked], None).await?;
            Ok(stored.into_iter().map(files::uploaded).collect())
        }
    }
}
