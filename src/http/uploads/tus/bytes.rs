//! Where an upload's bytes are: on this machine's disk, or in pieces that another server took.

use crate::http::error::{ApiError, Code};
use crate::http::state::AppState;
use crate::http::uploads::intake::disk;
use crate::store::{Piece, Upload, keep_free};

/// Brings the bytes of an upload that count here, where another server took some. Whoever calls has the upload.
pub(super) async fn bring_here(state: &AppState, upload: &Upload) -> Result<(), ApiError> {
    let Some(missing) = missing_here(state, upload).await? else { return Ok(()) };
    let (staging, reserve) = (state.blobs.staging(), state.limits.disk_reserve);
    let has_room = || keep_free(staging, reserve);
    Ok(state.blobs.bring_pieces(upload.id, missing.have, &missing.pieces, has_room).await?)
}

/// Refuses to go on with an upload whose bytes are neither here nor can be brought here.
pub(super) async fn require_somewhere(state: &AppState, upload: &Upload) -> Result<(), ApiError> {
    missing_here(state, upload).await.map(drop)
}

/// What of an upload's bytes is not on this disk.
struct Missing {
    /// How many of the first bytes are.
    have: u64,
    /// The others, in order.
    pieces: Vec<Piece>,
}

/// What has to be brought; `None` where nothing has to. Refuses where it is not to be had.
async fn missing_here(state: &AppState, upload: &Upload) -> Result<Option<Missing>, ApiError> {
    if upload.outcome.is_some() {
        return Ok(None);
    }
    let file = state.blobs.upload_file(upload.id);
    let length = match tokio::fs::metadata(&file).await {
        Ok(found) => Some(found.len()),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
        Err(error) => return Err(disk(&file, error)),
    };
    let holds = |bytes: u64| length.is_some_and(|length| length >= bytes);
    let home = state.blobs.home();
    if (upload.home.is_none() || upload.home == home) && holds(upload.received) {
        return Ok(None);
    }
    let mut pieces = match home {
        Some(_) => state.store.upload_pieces(upload.id).await?,
        None => Vec::new(),
    };
    let own = pieces.iter().filter(|piece| Some(piece.home) == home).map(|piece| piece.to);
    let have = own.max().filter(|have| holds(*have)).unwrap_or(0);
    pieces.retain(|piece| piece.to > have);
    let end = pieces.iter().try_fold(have, |at, piece| (piece.from == at).then_some(piece.to));
    if home.is_none() || end != Some(upload.received) {
        let detail = "the upload's bytes are not on this machine any more: begin a new one";
        return Err(ApiError::new(Code::UploadNotFound, detail));
    }
    Ok(Some(Missing { have, pieces }))
}
