//! Whether there is room for an upload, asked before its first byte is taken: the disk keeps a reserve, so that jobs that
//! run have room for what they write, and the organisation's quota holds.

use crate::config::Limits;
use crate::http::controllers::usage;
use crate::http::error::{ApiError, Code};
use crate::http::middleware::access::{Caller, refuse};
use crate::http::middleware::encoding;
use crate::http::state::AppState;
use crate::store::{ImageName, SurveyId, SurveyPath};
use axum::body::Body;
use axum::extract::{MatchedPath, RawPathParams, Request, State};
use axum::http::{HeaderMap, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures::StreamExt;
use heliomap_model::PlantId;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};
use uuid::Uuid;

/// Least bytes per second of an upload, on average, once it lasts longer than two times the patience with one that stands
/// still: a line may be slow, but nobody keeps a connection for a byte now and then.
const LEAST_BYTES_PER_SECOND: f64 = 256.0;

/// How much of an upload comes before the disk is looked at again. Many uploads at once stay within the reserve.
const LOOK_EVERY_BYTES: u64 = 16 << 20;

/// Lets an upload through, or says why not.
pub async fn admit(
    State(state): State<AppState>,
    path: MatchedPath,
    parameters: RawPathParams,
    request: Request,
    next: Next,
) -> Response {
    if !matches!(*request.method(), Method::PUT | Method::POST | Method::PATCH) {
        return next.run(request).await;
    }
    if let Err(problem) = encoding::require_as_it_is(request.method(), request.headers()) {
        return refuse(request, problem).await;
    }
    let bytes = announced(request.headers(), &state.limits);
    // What a resumable upload brings is counted as one with its beginning.
    let resumable = path.as_str().contains("/uploads");
    let organisation = request.extensions().get::<Caller>().map(|caller| caller.organisation).filter(|_| !resumable);
    let room = match (room_on_disk(&state, bytes), organisation) {
        (Ok(()), Some(organisation)) => {
            usage::room(&state, organisation, bytes, may_be_there(&state, &parameters, bytes)).await
        }
        (Ok(()), None) => Ok(None),
        (Err(problem), _) => Err(problem),
    };
    let room = match room {
        Ok(room) => room,
        Err(problem) => return refuse(request, problem).await,
    };
    let (parts, body) = request.into_parts();
    let refused = Arc::new(OnceLock::new());
    let body = watched(state, body, room, refused.clone());
    let response = next.run(Request::from_parts(parts, body)).await;
    // The handler knows only that no more came.
    match refused.get() {
        Some(problem) => ApiError::clone(problem).into_response(),
        None => response,
    }
}

/// How many bytes a request says that it brings: the whole file's where it begins a resumable upload. What is more than
/// anything may have is refused for that, whatever room there is.
fn announced(headers: &HeaderMap, limits: &Limits) -> u64 {
    let number = |name: &str| headers.get(name).and_then(|value| value.to_str().ok()?.parse::<u64>().ok());
    let announced = number("upload-length").or_else(|| number(header::CONTENT_LENGTH.as_str()));
    let largest = limits.max_archive_size.max(limits.max_file_size).max(limits.max_image_size);
    announced.filter(|bytes| *bytes <= largest).unwrap_or(0)
}

/// Whether so many bytes, 0 where that is not known, may be in the survey already: storing them tells whether they count.
async fn may_be_there(state: &AppState, parameters: &RawPathParams, bytes: u64) -> Result<bool, ApiError> {
    let parameter = |name: &str| parameters.iter().find(|(known, _)| *known == name).map(|(_, value)| value);
    let id = |name: &str| parameter(name).and_then(|value| Uuid::try_parse(value).ok());
    let (Some(plant), Some(survey)) = (id("plant").map(PlantId), id("survey").map(SurveyId)) else {
        return Ok(false);
    };
    if state.store.survey(plant, survey).await?.is_none() {
        return Ok(false);
    }
    let place = match (parameter("name"), parameter("path")) {
        (Some(name), _) => ImageName::parse(name).map(|name| SurveyPath::of_image(&name)),
        (None, Some(path)) => SurveyPath::of_reconstruction(path),
        (None, None) => return Ok(!state.store.files(survey).await?.is_empty()),
    };
    let Ok(place) = place else { return Ok(false) };
    Ok(state.store.file(survey, &place).await?.is_some_and(|file| bytes == 0 || file.size == bytes))
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

/// A body that counts, and ends with an error where the disk gets full, there is more than there is room for, or it comes too
/// slowly. Only while it is waited for does its time run.
fn watched(state: AppState, body: Body, room: Option<u64>, refused: Arc<OnceLock<ApiError>>) -> Body {
    let timed = futures::stream::unfold((body.into_data_stream(), Duration::ZERO), |(mut body, waited)| async move {
        let begun = Instant::now();
        let chunk = body.next().await?;
        let waited = waited + begun.elapsed();
        Some(((chunk, waited), (body, waited)))
    });
    let grace = 2 * state.limits.request_timeout;
    let (mut since, mut sum) = (0, 0);
    let refuse = move |problem: ApiError| {
        let error = axum::Error::new(std::io::Error::other(problem.detail.clone()));
        // The first reason is told.
        let _ = refused.set(problem);
        error
    };
    Body::from_stream(timed.fuse().map(move |(chunk, waited): (Result<Bytes, _>, Duration)| {
        let chunk = chunk?;
        state.metrics.upload_bytes.inc_by(chunk.len() as u64);
        since += chunk.len() as u64;
        sum += chunk.len() as u64;
        if let Some(room) = room.filter(|room| sum > *room) {
            return Err(refuse(usage::no_room(room)));
        }
        if waited > grace && (sum as f64) < waited.as_secs_f64() * LEAST_BYTES_PER_SECOND {
            let detail = format!(
                "{sum} bytes came in {} s, which is too slow; where the line is that bad, send it as a resumable upload",
                waited.as_secs()
            );
            return Err(refuse(ApiError::new(Code::UploadStalled, detail)));
        }
        if since >= LOOK_EVERY_BYTES {
            since = 0;
            room_on_disk(&state, 0).map_err(&refuse)?;
        }
        Ok::<_, axum::Error>(chunk)
    }))
}
