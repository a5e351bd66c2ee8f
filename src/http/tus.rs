//! Resumable uploads by the tus protocol 1.0 (<https://tus.io/protocols/resumable-upload>) with creation, expiration,
//! checksum, termination and concatenation.
//!
//! It is spoken here and not by a library, because those that there are count the bytes of a request only once all have
//! come: over a line that breaks every minute a large file would never get through. Here every eight megabytes are made
//! safe, and whatever came before a line broke counts.

use super::AppState;
use super::error::{ApiError, Code, Problem};
use super::extract::ApiPath;
use super::intake::{self, disk};
use super::uploads::{self, UploadedFile};
use crate::plant::PlantId;
use crate::store::{Content, Digest, ImageName, StagedFile, SurveyId, SurveyPath, Upload, UploadId};
use axum::Json;
use axum::body::{Body, BodyDataStream};
use axum::extract::State;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use futures::StreamExt;
use jiff::{SignedDuration, Timestamp};
use serde::Serialize;
use sha2::Digest as _;
use std::collections::HashMap;
use std::io::SeekFrom;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::io::{AsyncSeekExt, AsyncWriteExt, BufWriter};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

const VERSION: &str = "1.0.0";
const EXTENSIONS: &str = "creation,expiration,checksum,termination,concatenation";
const ALGORITHMS: &str = "sha1,sha256";
/// The place that stands for a whole archive in place of one file.
const ARCHIVE: &str = "reconstruction";

/// How long an upload lives after its last byte.
const LIFE: SignedDuration = SignedDuration::from_hours(24);
/// After so many bytes what came is made safe.
const STEP: u64 = 8 << 20;
/// How long a request waits for the one before it, which it interrupts, to make safe what came.
const TURN: Duration = Duration::from_secs(10);
/// Longest metadata that is kept.
const MAX_METADATA_BYTES: usize = 4096;
/// Most parts of one file.
const MAX_PARTS: usize = 1000;

/// Who writes to which upload: one request at a time, and the newest wins, for a client that comes back from another
/// address while the service still waits for its old connection.
#[derive(Debug, Default)]
pub struct Desk(Mutex<HashMap<UploadId, Seat>>);

#[derive(Debug, Default, Clone)]
struct Seat {
    turn: Arc<tokio::sync::Mutex<()>>,
    interrupt: CancellationToken,
}

/// An upload in the hands of one request.
struct Taken {
    desk: Arc<Desk>,
    id: UploadId,
    /// Raised when a newer request wants the upload.
    interrupt: CancellationToken,
    _turn: tokio::sync::OwnedMutexGuard<()>,
}

impl Desk {
    fn seats(&self) -> std::sync::MutexGuard<'_, HashMap<UploadId, Seat>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Interrupts whoever has the upload, and takes it until the answer is dropped.
    async fn take(self: &Arc<Self>, id: UploadId) -> Result<Taken, ApiError> {
        let (turn, interrupt) = {
            let mut seats = self.seats();
            let seat = seats.entry(id).or_default();
            std::mem::take(&mut seat.interrupt).cancel();
            (seat.turn.clone(), seat.interrupt.clone())
        };
        let busy =
            || ApiError::new(Code::UploadBusy, "another request to this upload is being finished").retry_after(2);
        let turn = tokio::time::timeout(TURN, turn.lock_owned()).await.map_err(|_| busy())?;
        Ok(Taken { desk: self.clone(), id, interrupt, _turn: turn })
    }
}

impl Drop for Taken {
    fn drop(&mut self) {
        let mut seats = self.desk.seats();
        // The map's and this one's: nobody waits.
        if seats.get(&self.id).is_some_and(|seat| Arc::strong_count(&seat.turn) == 2) {
            seats.remove(&self.id);
        }
    }
}

/// How an upload stands.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct UploadView {
    #[schema(value_type = Uuid)]
    pub id: UploadId,
    /// Bytes of the whole file.
    pub length: u64,
    /// Bytes that are safe.
    pub offset: u64,
    /// When it is forgotten, unless more comes.
    #[schema(value_type = String, format = DateTime)]
    pub expires: Timestamp,
    /// What became of the whole file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub outcome: Option<Outcome>,
}

/// What became of a whole file: stored, or refused.
#[derive(Debug, Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Outcome {
    /// The files that it was, one but for an archive.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schema(value_type = Vec<UploadedFile>)]
    pub files: Vec<serde_json::Value>,
    /// Why it was refused, a problem document.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Problem>)]
    pub problem: Option<serde_json::Value>,
}

/// Every answer says which protocol it is of.
fn answer(outcome: Result<Response, ApiError>) -> Response {
    // The protocol has a status of its own for this.
    const MISMATCH: u16 = 460;
    let mismatch = matches!(&outcome, Err(problem) if problem.code == Code::ChecksumMismatch);
    let outcome = outcome.map_err(|problem| if mismatch { problem.with("status", MISMATCH) } else { problem });
    let mut response = outcome.unwrap_or_else(IntoResponse::into_response);
    if mismatch && let Ok(status) = StatusCode::from_u16(MISMATCH) {
        *response.status_mut() = status;
    }
    let headers = response.headers_mut();
    headers.insert("tus-resumable", HeaderValue::from_static(VERSION));
    if response.status() == StatusCode::PRECONDITION_FAILED {
        response.headers_mut().insert("tus-version", HeaderValue::from_static(VERSION));
    }
    response
}

fn wrong(what: impl Into<String>) -> ApiError {
    ApiError::new(Code::BadRequest, what.into())
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> Result<Option<&'a str>, ApiError> {
    let value = headers.get(name).map(HeaderValue::to_str).transpose();
    value.map_err(|_| wrong(format!("the header {name} holds what is no text")))
}

fn number(headers: &HeaderMap, name: &str) -> Result<u64, ApiError> {
    let value = text(headers, name)?.ok_or_else(|| wrong(format!("the header {name} is missing")))?;
    value.parse().map_err(|_| wrong(format!("the header {name} must be a whole number, and not `{value}`")))
}

fn require_version(headers: &HeaderMap) -> Result<(), ApiError> {
    match text(headers, "tus-resumable")? {
        Some(VERSION) => Ok(()),
        _ => Err(ApiError::new(Code::TusVersion, "send the header `Tus-Resumable: 1.0.0`")),
    }
}

/// Where a file belongs, by what its client told: `path`, its place in the survey's folder (or `reconstruction` for an
/// archive), or else `filename` or `name`, that of a photo.
enum Place {
    File(SurveyPath),
    Archive,
}

impl Place {
    fn of(metadata: &str) -> Result<Self, ApiError> {
        let mut told: HashMap<&str, String> = HashMap::new();
        for pair in metadata.split(',').map(str::trim).filter(|pair| !pair.is_empty()) {
            let (name, value) = pair.split_once(' ').unwrap_or((pair, ""));
            let value = BASE64_STANDARD.decode(value.trim()).ok().and_then(|bytes| String::from_utf8(bytes).ok());
            told.insert(name, value.ok_or_else(|| wrong(format!("{name} in Upload-Metadata is no base64 of UTF-8")))?);
        }
        match (told.get("path"), told.get("filename").or(told.get("name"))) {
            (Some(path), _) if path == ARCHIVE => Ok(Self::Archive),
            (Some(path), _) => Ok(Self::File(SurveyPath::parse(path)?)),
            (None, Some(name)) => Ok(Self::File(SurveyPath::of_image(&ImageName::parse(name)?))),
            (None, None) => {
                Err(wrong("Upload-Metadata must tell `filename` (of a photo) or `path` (in the survey's folder)"))
            }
        }
    }

    fn name(&self) -> &str {
        match self {
            Self::File(path) => path.as_str(),
            Self::Archive => "the archive",
        }
    }

    fn max_bytes(&self, state: &AppState) -> u64 {
        match self {
            Self::Archive => state.limits.max_archive_size,
            Self::File(path) if path.content() == Content::Image => state.limits.max_image_size,
            Self::File(_) => state.limits.max_file_size,
        }
    }
}

fn place(plant: PlantId, survey: SurveyId, id: UploadId) -> String {
    format!("/api/v1/plants/{plant}/surveys/{survey}/uploads/{id}")
}

/// The time of an upload's end, as the protocol writes it.
fn http_date(time: Timestamp) -> String {
    time.strftime("%a, %d %b %Y %H:%M:%S GMT").to_string()
}

async fn require_upload(state: &AppState, survey: SurveyId, id: UploadId) -> Result<Upload, ApiError> {
    let found = state.store.upload(survey, id).await?.filter(|upload| upload.expires > Timestamp::now());
    found.ok_or_else(|| {
        ApiError::new(
            Code::UploadNotFound,
            format!("no upload to this survey has the identifier {id}; begin a new one"),
        )
    })
}

/// What this service speaks of the tus protocol
#[utoipa::path(
    options,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads",
    tag = "surveys",
    security(()),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier")
    ),
    responses(
        (status = 204, description = "See the headers", headers(("tus-version" = String), ("tus-extension" = String),
            ("tus-max-size" = u64), ("tus-checksum-algorithm" = String))),
        (status = 404, description = "`not_found`: identifiers are UUIDs", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn options(State(state): State<AppState>, _place: ApiPath<(PlantId, SurveyId)>) -> Response {
    let largest = state.limits.max_archive_size.max(state.limits.max_file_size).to_string();
    let headers = [
        ("tus-version", VERSION),
        ("tus-extension", EXTENSIONS),
        ("tus-max-size", largest.as_str()),
        ("tus-checksum-algorithm", ALGORITHMS),
    ];
    answer(Ok((StatusCode::NO_CONTENT, headers).into_response()))
}

/// Begin an upload that may be resumed (tus 1.0)
///
/// `Upload-Length` says how large the file is, `Upload-Metadata` where it belongs: `filename` for a photo, or `path` in the
/// survey's folder, or `path` of `reconstruction` for a zip or tar. With `Upload-Concat: partial` it is a part of a file,
/// with `Upload-Concat: final;URL URL …` the file is put together from its parts.
#[utoipa::path(
    post,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("tus-resumable" = String, Header, pattern = "^1\\.0\\.0$", description = "`1.0.0`"),
        ("upload-length" = Option<u64>, Header, description = "Bytes of the file"),
        ("upload-metadata" = Option<String>, Header, description = "Names, each with its value in base64"),
        ("upload-concat" = Option<String>, Header, description = "`partial`, or `final;` and the parts")
    ),
    responses(
        (status = 201, description = "Send its bytes to `location`", headers(("location" = String),
            ("upload-expires" = String))),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `upload_not_found` (a part), `tus_version`, \
            `bad_request`, `invalid_name`, `unknown_file`, `too_large`; a file put together: as `PUT` of that file",
            body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "`storage_full`, `quota_exceeded`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn create(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    headers: HeaderMap,
) -> Response {
    answer(create_upload(&state, plant, survey, &headers).await)
}

async fn create_upload(
    state: &AppState,
    plant: PlantId,
    survey: SurveyId,
    headers: &HeaderMap,
) -> Result<Response, ApiError> {
    state.require_survey(plant, survey).await?;
    require_version(headers)?;
    let metadata = text(headers, "upload-metadata")?.unwrap_or_default();
    if metadata.len() > MAX_METADATA_BYTES {
        return Err(wrong(format!("Upload-Metadata is longer than {MAX_METADATA_BYTES} bytes")));
    }
    let concat = text(headers, "upload-concat")?;
    let partial = concat == Some("partial");
    let parts = match concat.and_then(|concat| concat.strip_prefix("final;")) {
        Some(urls) => Some(finished_parts(state, survey, urls).await?),
        None if concat.is_none() || partial => None,
        None => return Err(wrong("Upload-Concat must be `partial`, or `final;` and the URLs of the parts")),
    };
    let length = match &parts {
        Some(parts) => parts.iter().map(|part| part.length).sum(),
        None => number(headers, "upload-length")?,
    };
    let (name, limit) = match partial {
        true => ("the part".to_owned(), state.limits.max_archive_size.max(state.limits.max_file_size)),
        false => {
            let place = Place::of(metadata)?;
            (place.name().to_owned(), place.max_bytes(state))
        }
    };
    if length > limit {
        return Err(intake::too_large(&name, limit));
    }
    let id = UploadId(Uuid::new_v4());
    let file = state.blobs.upload_file(id);
    let sources: Vec<_> = parts.iter().flatten().map(|part| state.blobs.upload_file(part.id)).collect();
    let target = file.clone();
    let put_together = tokio::task::spawn_blocking(move || {
        let mut whole = std::fs::File::create_new(&target)?;
        for source in sources {
            std::io::copy(&mut std::fs::File::open(source)?, &mut whole)?;
        }
        whole.sync_all()
    });
    put_together.await.map_err(|error| ApiError::internal(&error))?.map_err(|error| disk(&file, error))?;
    let upload = Upload {
        id,
        survey,
        length,
        received: if parts.is_some() { length } else { 0 },
        partial,
        metadata: metadata.to_owned(),
        expires: Timestamp::now() + LIFE,
        outcome: None,
    };
    state.store.create_upload(&upload).await?;
    if upload.received == length {
        finish(state, plant, &upload).await?;
    }
    for part in parts.iter().flatten() {
        state.store.delete_upload(survey, part.id).await?;
        remove(&state.blobs.upload_file(part.id)).await;
    }
    let headers = [(header::LOCATION, place(plant, survey, id)), (UPLOAD_EXPIRES, http_date(upload.expires))];
    Ok((StatusCode::CREATED, headers).into_response())
}

const UPLOAD_EXPIRES: HeaderName = HeaderName::from_static("upload-expires");
const UPLOAD_OFFSET: HeaderName = HeaderName::from_static("upload-offset");

/// The parts of a file, all of which must be whole.
async fn finished_parts(state: &AppState, survey: SurveyId, urls: &str) -> Result<Vec<Upload>, ApiError> {
    let mut parts = Vec::new();
    for url in urls.split_ascii_whitespace() {
        let id = url.rsplit('/').next().and_then(|id| Uuid::try_parse(id).ok()).map(UploadId);
        let part =
            require_upload(state, survey, id.ok_or_else(|| wrong(format!("`{url}` is no upload's URL")))?).await?;
        if !part.partial || part.received < part.length {
            return Err(wrong(format!("{url} is no part that is whole")));
        }
        parts.push(part);
        if parts.len() > MAX_PARTS {
            return Err(wrong(format!("a file may have {MAX_PARTS} parts at the most")));
        }
    }
    if parts.is_empty() {
        return Err(wrong("Upload-Concat names no parts"));
    }
    Ok(parts)
}

/// How far an upload is (tus 1.0)
#[utoipa::path(
    head,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads/{upload}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("upload" = Uuid, Path, description = "The upload's identifier"),
        ("tus-resumable" = String, Header, pattern = "^1\\.0\\.0$", description = "`1.0.0`")
    ),
    responses(
        (status = 200, description = "Go on at `upload-offset`", headers(("upload-offset" = u64), ("upload-length" = u64),
            ("upload-expires" = String))),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `upload_not_found`, `upload_busy`, \
            `tus_version`")
    )
)]
pub async fn head(
    State(state): State<AppState>,
    ApiPath((plant, survey, id)): ApiPath<(PlantId, SurveyId, UploadId)>,
    headers: HeaderMap,
) -> Response {
    answer(tell(&state, plant, survey, id, &headers).await)
}

async fn tell(
    state: &AppState,
    plant: PlantId,
    survey: SurveyId,
    id: UploadId,
    headers: &HeaderMap,
) -> Result<Response, ApiError> {
    state.require_survey(plant, survey).await?;
    require_version(headers)?;
    let _taken = state.desk.take(id).await?;
    let upload = require_upload(state, survey, id).await?;
    if upload.received == upload.length {
        finish(state, plant, &upload).await?;
    }
    let mut answer = HeaderMap::new();
    answer.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    answer.insert(UPLOAD_OFFSET, upload.received.into());
    answer.insert("upload-length", upload.length.into());
    if let Ok(metadata) = HeaderValue::from_str(&upload.metadata)
        && !upload.metadata.is_empty()
    {
        answer.insert("upload-metadata", metadata);
    }
    if upload.partial {
        answer.insert("upload-concat", HeaderValue::from_static("partial"));
    }
    let expires = HeaderValue::from_str(&http_date(upload.expires)).map_err(|error| ApiError::internal(&error))?;
    answer.insert(UPLOAD_EXPIRES, expires);
    Ok((StatusCode::OK, answer).into_response())
}

/// How an upload stands, and what became of the whole file
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads/{upload}",
    tag = "surveys",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("upload" = Uuid, Path, description = "The upload's identifier")
    ),
    responses(
        (status = 200, body = UploadView),
        (status = 404, description = "`plant_not_found`, `survey_not_found`, `upload_not_found`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn get(
    State(state): State<AppState>,
    ApiPath((plant, survey, id)): ApiPath<(PlantId, SurveyId, UploadId)>,
) -> Result<Json<UploadView>, ApiError> {
    state.require_survey(plant, survey).await?;
    let upload = require_upload(&state, survey, id).await?;
    let outcome = upload.outcome.as_deref().map(serde_json::from_str).transpose();
    Ok(Json(UploadView {
        id,
        length: upload.length,
        offset: upload.received,
        expires: upload.expires,
        outcome: outcome.map_err(|error| ApiError::internal(&error))?,
    }))
}

/// Send more of an upload (tus 1.0)
///
/// What came counts even where the line breaks; with `Upload-Checksum` (`sha1` or `sha256`) only as a whole. The answer to
/// the last bytes tells whether the file was stored.
#[utoipa::path(
    patch,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads/{upload}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("upload" = Uuid, Path, description = "The upload's identifier"),
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
    ApiPath((plant, survey, id)): ApiPath<(PlantId, SurveyId, UploadId)>,
    headers: HeaderMap,
    body: Body,
) -> Response {
    answer(add(&state, plant, survey, id, &headers, body).await)
}

async fn add(
    state: &AppState,
    plant: PlantId,
    survey: SurveyId,
    id: UploadId,
    headers: &HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    state.require_survey(plant, survey).await?;
    require_version(headers)?;
    if text(headers, "content-type")? != Some("application/offset+octet-stream") {
        let what = "send the bytes with the header `content-type: application/offset+octet-stream`";
        return Err(ApiError::new(Code::UnsupportedMediaType, what));
    }
    let offset = number(headers, "upload-offset")?;
    let checksum = text(headers, "upload-checksum")?.map(Checksum::parse).transpose()?;
    let taken = state.desk.take(id).await?;
    let mut upload = require_upload(state, survey, id).await?;
    if offset != upload.received {
        let what =
            format!("{} bytes are safe, and these begin at {offset}: ask with HEAD where to go on", upload.received);
        return Err(ApiError::new(Code::UploadOffset, what).with("offset", upload.received));
    }
    receive(state, &mut upload, body.into_data_stream(), checksum, &taken.interrupt).await?;
    if upload.received == upload.length {
        finish(state, plant, &upload).await?;
    }
    let headers = [(UPLOAD_OFFSET, upload.received.to_string()), (UPLOAD_EXPIRES, http_date(upload.expires))];
    Ok((StatusCode::NO_CONTENT, headers).into_response())
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
                break Some(ApiError::new(Code::UploadInterrupted, "a newer request goes on with this upload"));
            }
            next = tokio::time::timeout(idle, body.next()) => next,
        };
        let chunk = match next {
            Ok(None) => break None,
            Ok(Some(Ok(chunk))) => chunk,
            Ok(Some(Err(_))) => {
                break Some(ApiError::new(Code::UploadInterrupted, "the line broke; ask with HEAD where to go on"));
            }
            Err(_) => break Some(ApiError::new(Code::UploadStalled, "nothing came; ask with HEAD where to go on")),
        };
        if chunk.len() as u64 > upload.length - at {
            break Some(wrong(format!("there is more than the {} bytes that were announced", upload.length)));
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
    upload.received = at;
    upload.expires = Timestamp::now() + LIFE;
    if !state.store.upload_received(upload.id, at, upload.expires).await? {
        return Err(ApiError::new(Code::UploadNotFound, "the upload was ended meanwhile"));
    }
    Ok(())
}

/// Checks a whole file and stores it in its survey, once; a part waits for the others.
async fn finish(state: &AppState, plant: PlantId, upload: &Upload) -> Result<(), ApiError> {
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
    remove(&state.blobs.upload_file(upload.id)).await;
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
            let stored = intake::store(state, plant, upload.survey, vec![checked]).await?;
            Ok(stored.into_iter().map(uploads::uploaded).collect())
        }
    }
}

/// End an upload and forget it (tus 1.0)
#[utoipa::path(
    delete,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads/{upload}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("upload" = Uuid, Path, description = "The upload's identifier"),
        ("tus-resumable" = String, Header, pattern = "^1\\.0\\.0$", description = "`1.0.0`")
    ),
    responses(
        (status = 204, description = "Gone; a file that was stored stays"),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `upload_not_found`, `upload_busy`, \
            `tus_version`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn terminate(
    State(state): State<AppState>,
    ApiPath((plant, survey, id)): ApiPath<(PlantId, SurveyId, UploadId)>,
    headers: HeaderMap,
) -> Response {
    answer(end(&state, plant, survey, id, &headers).await)
}

async fn end(
    state: &AppState,
    plant: PlantId,
    survey: SurveyId,
    id: UploadId,
    headers: &HeaderMap,
) -> Result<Response, ApiError> {
    state.require_survey(plant, survey).await?;
    require_version(headers)?;
    let _taken = state.desk.take(id).await?;
    require_upload(state, survey, id).await?;
    state.store.delete_upload(survey, id).await?;
    remove(&state.blobs.upload_file(id)).await;
    Ok(StatusCode::NO_CONTENT.into_response())
}

/// As `PATCH` or `DELETE`, for clients that cannot send these: the header `X-HTTP-Method-Override` tells which
#[utoipa::path(
    post,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads/{upload}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("upload" = Uuid, Path, description = "The upload's identifier"),
        ("x-http-method-override" = String, Header, pattern = "^(PATCH|DELETE)$", description = "`PATCH` or `DELETE`")
    ),
    request_body(content = Vec<u8>, content_type = "application/offset+octet-stream", description = "The bytes"),
    responses(
        (status = 204, description = "As the method that it stands for"),
        (status = "4XX", description = "As the method that it stands for", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn post(
    State(state): State<AppState>,
    ApiPath((plant, survey, id)): ApiPath<(PlantId, SurveyId, UploadId)>,
    headers: HeaderMap,
    body: Body,
) -> Response {
    let method = headers.get("x-http-method-override").and_then(|value| Method::from_bytes(value.as_bytes()).ok());
    answer(match method {
        Some(Method::PATCH) => add(&state, plant, survey, id, &headers, body).await,
        Some(Method::DELETE) => end(&state, plant, survey, id, &headers).await,
        _ => Err(ApiError::new(Code::MethodNotAllowed, "send PATCH, or the header `X-HTTP-Method-Override: PATCH`")),
    })
}

/// Deletes a file; one that cannot be deleted now is swept up later.
async fn remove(path: &Path) {
    if let Err(error) = tokio::fs::remove_file(path).await
        && error.kind() != std::io::ErrorKind::NotFound
    {
        tracing::warn!(%error, path = %path.display(), "an upload's file cannot be deleted");
    }
}

/// The digest that the bytes of a request must have.
struct Checksum {
    expected: Vec<u8>,
    hasher: Hasher,
}

enum Hasher {
    Sha1(Box<sha1::Sha1>),
    Sha256(Box<sha2::Sha256>),
}

impl Checksum {
    fn parse(header: &str) -> Result<Self, ApiError> {
        let (algorithm, digest) = header.split_once(' ').unwrap_or((header, ""));
        let (hasher, length) = match algorithm {
            "sha1" => (Hasher::Sha1(Box::default()), 20),
            "sha256" => (Hasher::Sha256(Box::default()), 32),
            _ => return Err(wrong(format!("Upload-Checksum must be of one of {ALGORITHMS}"))),
        };
        let expected = BASE64_STANDARD.decode(digest.trim()).ok().filter(|digest| digest.len() == length);
        let expected = expected.ok_or_else(|| wrong("Upload-Checksum must hold the digest in base64"))?;
        Ok(Self { expected, hasher })
    }

    fn update(&mut self, bytes: &[u8]) {
        match &mut self.hasher {
            Hasher::Sha1(hasher) => hasher.update(bytes),
            Hasher::Sha256(hasher) => hasher.update(bytes),
        }
    }

    fn mismatch(self) -> Option<ApiError> {
        let digest = match self.hasher {
            Hasher::Sha1(hasher) => hasher.finalize().to_vec(),
            Hasher::Sha256(hasher) => hasher.finalize().to_vec(),
        };
        let what = "the bytes came changed, and nothing of them counts; send them again";
        (digest != self.expected).then(|| ApiError::new(Code::ChecksumMismatch, what))
    }
}
