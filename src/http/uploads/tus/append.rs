//! More of an upload comes, and is made safe step by step.

use super::bytes::bring_here;
use super::finish::finish;
use super::protocol::{Checksum, UPLOAD_EXPIRES, UPLOAD_OFFSET, answer, http_date, number, text, wrong};
use super::{LIFE, UploadPath, found, take_over};
use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::ApiPath;
use crate::http::state::AppState;
use crate::http::uploads::intake::disk;
use crate::store::Upload;
use axum::body::{Body, BodyDataStream};
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures::StreamExt;
use jiff::Timestamp;
use std::io::SeekFrom;
use std::path::Path;
use tokio::io::{AsyncSeekExt, AsyncWriteExt, BufWriter};
use tokio_util::sync::CancellationToken;

/// After so many bytes what came is made safe.
const STEP: u64 = 8 << 20;

/// Send more of an upload (tus 1.0)
///
/// What came counts even where the line breaks; with `Upload-Checksum` (`sha1` or `sha256`) only as a whole. The answer to
/// the last bytes tells whether the file was stored; no bytes at the end of a whole upload are told it again.
#[utoipa::path(
    patch,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads/{upload}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        UploadPath,
        ("tus-resumable" = String, Header, pattern = "^1\\.0\\.0$", description = "`1.0.0`"),
        ("upload-offset" = u64, Header, description = "Where these bytes begin"),
        ("upload-checksum" = Option<String>, Header, description = "Algorithm and digest in base64")
    ),
    request_body(content = Vec<u8>, content_type = "application/offset+octet-stream", description = "The bytes"),
    responses(
        (status = 204, description = "Safe", headers(("upload-offset" = u64), ("upload-expires" = String))),
        (status = 460, description = "`checksum_mismatch`: nothing of it counts", body = Problem,
            content_type = "application/problem+json"),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `upload_not_found`, `upload_offset`, \
            `upload_busy`, `upload_interrupted`, `upload_stalled`, `tus_version`, `bad_request`, `too_large`, \
            `unsupported_media_type`; after the last byte: as `PUT` of the file",
            body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "`storage_full`, `quota_exceeded`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn patch(
    State(state): State<AppState>,
    ApiPath(path): ApiPath<UploadPath>,
    headers: HeaderMap,
    body: Body,
) -> Response {
    answer(add(&state, &path, &headers, body).await)
}

pub(super) async fn add(
    state: &AppState,
    path: &UploadPath,
    headers: &HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    // All that can be wrong with a request is found before it takes the upload from one that is running.
    let upload = found(state, path, headers).await?;
    let announced = Announced::read(headers)?;
    announced.require_fits(&upload)?;
    // Whoever had it may have made more safe on the way out.
    let (taken, mut upload) = take_over(state, path).await?;
    bring_here(state, &upload).await?;
    announced.require_fits(&upload)?;
    let body = body.into_data_stream();
    match upload.received == upload.length {
        // Its file may be gone already: a request whose answer was lost comes again.
        true => nothing_more(state, &upload, body, announced.checksum).await?,
        false => receive(state, &mut upload, body, announced.checksum, &taken.interrupt).await?,
    }
    if upload.received == upload.length {
        finish(state, path.plant, &upload).await?;
    }
    let headers = [(UPLOAD_OFFSET, upload.received.to_string()), (UPLOAD_EXPIRES, http_date(upload.expires))];
    Ok((StatusCode::NO_CONTENT, headers).into_response())
}

/// What a request says of the bytes that it brings.
struct Announced {
    offset: u64,
    /// How many, where that is said.
    length: Option<u64>,
    checksum: Option<Checksum>,
}

impl Announced {
    fn read(headers: &HeaderMap) -> Result<Self, ApiError> {
        if text(headers, "content-type")? != Some("application/offset+octet-stream") {
            let what = "send the bytes with the header `content-type: application/offset+octet-stream`";
            return Err(ApiError::new(Code::UnsupportedMediaType, what));
        }
        Ok(Self {
            offset: number(headers, "upload-offset")?,
            length: headers.get(header::CONTENT_LENGTH).and_then(|value| value.to_str().ok()?.parse().ok()),
            checksum: text(headers, "upload-checksum")?.map(Checksum::parse).transpose()?,
        })
    }

    /// Refuses bytes that do not go on where an upload is, or go beyond its end.
    fn require_fits(&self, upload: &Upload) -> Result<(), ApiError> {
        let Upload { received, length, .. } = *upload;
        if self.offset != received {
            let what =
                format!("{received} bytes are safe, and these begin at {}: ask with HEAD where to go on", self.offset);
            return Err(ApiError::new(Code::UploadOffset, what).with("offset", received));
        }
        if self.length.is_some_and(|more| more > length - received) {
            return Err(too_much(length));
        }
        Ok(())
    }
}

fn too_much(length: u64) -> ApiError {
    wrong(format!("there is more than the {length} bytes that were announced"))
}

/// Refuses what comes to an upload that is whole, unless it is nothing; and where the whole was refused, says so again.
async fn nothing_more(
    state: &AppState,
    upload: &Upload,
    mut body: BodyDataStream,
    checksum: Option<Checksum>,
) -> Result<(), ApiError> {
    loop {
        match tokio::time::timeout(state.limits.request_timeout, body.next()).await {
            Ok(None) => break,
            Ok(Some(Ok(chunk))) if chunk.is_empty() => {}
            Ok(Some(Ok(_))) => return Err(too_much(upload.length)),
            Ok(Some(Err(_))) => return Err(line_broke()),
            Err(_) => return Err(stalled()),
        }
    }
    checksum.and_then(Checksum::mismatch).map_or(Ok(()), Err)?;
    match super::outcome(upload)?.and_then(|outcome| outcome.problem) {
        Some(problem) => Err(ApiError::told_before(&problem)),
        None => Ok(()),
    }
}

fn line_broke() -> ApiError {
    ApiError::new(Code::UploadInterrupted, "the line broke; ask with HEAD where to go on")
}

fn taken_over() -> ApiError {
    ApiError::new(Code::UploadInterrupted, "a newer request goes on with this upload")
}

fn stalled() -> ApiError {
    ApiError::new(Code::UploadStalled, "nothing came; ask with HEAD where to go on")
}

/// Appends what comes to an upload's file, and says in `upload` how much of it is safe.
async fn receive(
    state: &AppState,
    upload: &mut Upload,
    mut body: BodyDataStream,
    mut checksum: Option<Checksum>,
    interrupt: &CancellationToken,
) -> Result<(), ApiError> {
    let path = state.blobs.upload_file(upload.id);
    let io = |error| disk(&path, error);
    let mut file = tokio::fs::OpenOptions::new().write(true).open(&path).await.map_err(io)?;
    // What a crash left behind what is safe.
    file.set_len(upload.received).await.map_err(io)?;
    file.seek(SeekFrom::Start(upload.received)).await.map_err(io)?;
    let mut file = BufWriter::with_capacity(256 << 10, file);
    let mut at = upload.received;
    let idle = state.limits.request_timeout;
    let broken = loop {
        let next = tokio::select! {
            () = interrupt.cancelled() => {
                break Some(taken_over());
            }
            next = tokio::time::timeout(idle, body.next()) => next,
        };
        let chunk = match next {
            Ok(None) => break None,
            Ok(Some(Ok(chunk))) => chunk,
            Ok(Some(Err(_))) => break Some(line_broke()),
            Err(_) => break Some(stalled()),
        };
        if chunk.len() as u64 > upload.length - at {
            break Some(too_much(upload.length));
        }
        if let Some(checksum) = &mut checksum {
            checksum.update(&chunk);
        }
        file.write_all(&chunk).await.map_err(io)?;
        at += chunk.len() as u64;
        if checksum.is_none() && at - upload.received >= STEP {
            secure(state, upload, &mut file, at, &path).await?;
        }
    };
    if let Some(checksum) = checksum {
        let problem = broken.or_else(|| checksum.mismatch());
        if let Some(problem) = problem {
            return Err(problem);
        }
        return secure(state, upload, &mut file, at, &path).await;
    }
    secure(state, upload, &mut file, at, &path).await?;
    broken.map_or(Ok(()), Err)
}

/// Makes safe what was written.
async fn secure(
    state: &AppState,
    upload: &mut Upload,
    file: &mut BufWriter<tokio::fs::File>,
    at: u64,
    path: &Path,
) -> Result<(), ApiError> {
    file.flush().await.map_err(|error| disk(path, error))?;
    file.get_ref().sync_data().await.map_err(|error| disk(path, error))?;
    let pieces = state.blobs.keep_pieces(upload.id, upload.received, at).await?;
    let (home, expires) = (state.blobs.home(), Timestamp::now() + LIFE);
    if !state.store.upload_received(upload, at, home, &pieces, expires).await? {
        state.blobs.drop_pieces(upload.id, &pieces).await;
        return Err(match state.store.upload(upload.survey, upload.id).await? {
            None => ApiError::new(Code::UploadNotFound, "the upload was ended meanwhile"),
            Some(_) => taken_over(),
        });
    }
    (upload.received, upload.home, upload.expires) = (at, home, expires);
    Ok(())
}
