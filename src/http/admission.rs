//! Whether there is room for an upload, asked before its first byte is taken: the disk keeps a reserve, so that jobs that
//! run have room for what they write.

use super::AppState;
use super::error::{ApiError, Code};
use super::guard::refuse;
use crate::config::Limits;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, Method, header};
use axum::middleware::Next;
use axum::response::Response;
use futures::StreamExt;

/// How much of an upload comes before the disk is looked at again. Many uploads at once stay within the reserve.
const LOOK_EVERY_BYTES: u64 = 16 << 20;

/// Lets an upload through, or says why not.
pub async fn admit(State(state): State<AppState>, request: Request, next: Next) -> Response {
    if !matches!(*request.method(), Method::PUT | Method::POST | Method::PATCH) {
        return next.run(request).await;
    }
    if let Err(problem) = room_on_disk(&state, announced(request.headers(), &state.limits)) {
        return refuse(request, problem).await;
    }
    let (parts, body) = request.into_parts();
    next.run(Request::from_parts(parts, watched(state, body))).await
}

/// How many bytes a request says that it brings: the whole file's where it begins a resumable upload. What is more than
/// anything may have is refused for that, whatever room there is.
fn announced(headers: &HeaderMap, limits: &Limits) -> u64 {
    let number = |name: &str| headers.get(name).and_then(|value| value.to_str().ok()?.parse::<u64>().ok());
    let announced = number("upload-length").or_else(|| number(header::CONTENT_LENGTH.as_str()));
    let largest = limits.max_archive_size.max(limits.max_file_size).max(limits.max_image_size);
    announced.filter(|bytes| *bytes <= largest).unwrap_or(0)
}

fn room_on_disk(state: &AppState, bytes: u64) -> Result<(), ApiError> {
    let free = state.blobs.free_bytes()?;
    if free.saturating_sub(bytes) >= state.limits.disk_reserve {
        return Ok(());
    }
    tracing::warn!(free, reserve = state.limits.disk_reserve, "no room for an upload");
    Err(ApiError::new(
        Code::StorageFull,
        "the service's disk has no room for this upload; nothing of it was stored, send it again once whoever runs the \
         service has made room",
    )
    .retry_after(60))
}

/// A body that counts, and ends with an error where the disk gets full.
fn watched(state: AppState, body: Body) -> Body {
    let mut since = 0;
    Body::from_stream(body.into_data_stream().map(move |chunk| {
        let chunk = chunk?;
        state.metrics.upload_bytes.inc_by(chunk.len() as u64);
        since += chunk.len() as u64;
        if since >= LOOK_EVERY_BYTES {
            since = 0;
            room_on_disk(&state, 0).map_err(|problem| axum::Error::new(std::io::Error::other(problem.detail)))?;
        }
        Ok::<_, axum::Error>(chunk)
    }))
}
