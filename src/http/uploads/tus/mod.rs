//! Resumable uploads by the tus protocol 1.0 (<https://tus.io/protocols/resumable-upload>) with creation, expiration,
//! checksum, termination and concatenation.
//!
//! It is spoken here and not by a library, because those that there are count the bytes of a request only once all have
//! come: over a line that breaks every minute a large file would never get through. Here every eight megabytes are made
//! safe, and whatever came before a line broke counts.

pub mod append;
pub mod begin;
pub mod list;

mod bytes;
mod finish;
mod locks;
mod place;
mod protocol;

pub use locks::Desk;

use crate::http::controllers::files::UploadedFile;
use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::ApiPath;
use crate::http::state::AppState;
use crate::store::{SurveyId, Upload, UploadId};
use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::{bring_here, require_somewhere};
use finish::finish;
use heliomap_model::PlantId;
use jiff::{SignedDuration, Timestamp};
use locks::Taken;
use place::Place;
use protocol::{ALGORITHMS, EXTENSIONS, UPLOAD_EXPIRES, UPLOAD_OFFSET, VERSION, answer, http_date, require_version};
use serde::{Deserialize, Serialize};
use std::str::FromStr;
use tracing::Instrument;

/// How long an upload lives after its last byte.
const LIFE: SignedDuration = SignedDuration::from_hours(24);

/// Where an upload is asked about.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Path)]
pub struct UploadPath {
    /// The plant's identifier
    #[param(value_type = Uuid)]
    plant: PlantId,
    /// The survey's identifier
    #[param(value_type = Uuid)]
    survey: SurveyId,
    /// The upload's identifier
    #[param(value_type = Uuid)]
    upload: UploadId,
}

/// How an upload stands.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct UploadView {
    #[schema(value_type = Uuid)]
    pub id: UploadId,
    /// Where its bytes go.
    #[schema(
        example = "/api/v1/plants/0b7a3f7e-59b1-4f0c-9f0d-3d6f3d1f7a11/surveys/5c1f4a9e-1a54-4d0e-8d6e-54d3a9be7a77/uploads/7d3c6f5b-2c7f-4f53-9a0c-2f5b6f0c9d21"
    )]
    pub location: String,
    /// The file's place in the survey's folder, or `reconstruction` where it is an archive; left out of a part of a file.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "images/DJI_0001.jpg")]
    pub path: Option<String>,
    pub state: UploadState,
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

/// Where an upload stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum UploadState {
    /// Bytes are missing or, of a part of a file, it was not put together yet.
    Unfinished,
    /// The file is in the survey.
    Stored,
    /// The file was refused; `outcome` tells why.
    Refused,
}

impl FromStr for UploadState {
    type Err = ();

    fn from_str(word: &str) -> Result<Self, ()> {
        match word {
            "unfinished" => Ok(Self::Unfinished),
            "stored" => Ok(Self::Stored),
            "refused" => Ok(Self::Refused),
            _ => Err(()),
        }
    }
}

impl UploadView {
    fn of(plant: PlantId, upload: Upload) -> Result<Self, ApiError> {
        let outcome = outcome(&upload)?;
        Ok(Self {
            id: upload.id,
            location: place(plant, upload.survey, upload.id),
            // What cannot be read was refused when the upload began, but where it is a part.
            path: Place::of(&upload.metadata).ok().filter(|_| !upload.partial).map(|place| place.told().to_owned()),
            state: match &outcome {
                None => UploadState::Unfinished,
                Some(Outcome { problem: None, .. }) => UploadState::Stored,
                Some(_) => UploadState::Refused,
            },
            length: upload.length,
            offset: upload.received,
            expires: upload.expires,
            outcome,
        })
    }
}

/// What became of a whole file: stored, or refused.
#[derive(Debug, Serialize, Deserialize, utoipa::ToSchema)]
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

fn place(plant: PlantId, survey: SurveyId, id: UploadId) -> String {
    format!("/api/v1/plants/{plant}/surveys/{survey}/uploads/{id}")
}

/// An upload that a request to its own address is about.
async fn found(state: &AppState, path: &UploadPath, headers: &HeaderMap) -> Result<Upload, ApiError> {
    state.require_survey(path.plant, path.survey).await?;
    require_version(headers)?;
    require_upload(state, path.survey, path.upload).await
}

/// As [`found`], in the hands of this request.
async fn take(state: &AppState, path: &UploadPath, headers: &HeaderMap) -> Result<(Taken, Upload), ApiError> {
    found(state, path, headers).await?;
    take_over(state, path).await
}

/// An upload that was found, in the hands of this request as whichever had it before leaves it, which is interrupted.
async fn take_over(state: &AppState, path: &UploadPath) -> Result<(Taken, Upload), ApiError> {
    let taken = state.desk.take(path.upload).await?;
    Ok((taken, require_upload(state, path.survey, path.upload).await?))
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

/// How far an upload is (tus 1.0)
#[utoipa::path(
    head,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads/{upload}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        UploadPath,
        ("tus-resumable" = String, Header, pattern = "^1\\.0\\.0$", description = "`1.0.0`")
    ),
    responses(
        (status = 200, description = "Go on at `upload-offset`", headers(("upload-offset" = u64), ("upload-length" = u64),
            ("upload-expires" = String))),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `upload_not_found`, `upload_busy`, \
            `tus_version`")
    )
)]
pub async fn head(State(state): State<AppState>, ApiPath(path): ApiPath<UploadPath>, headers: HeaderMap) -> Response {
    answer(tell(&state, &path, &headers).await)
}

async fn tell(state: &AppState, path: &UploadPath, headers: &HeaderMap) -> Result<Response, ApiError> {
    let (taken, upload) = take(state, path, headers).await?;
    if upload.received == upload.length {
        // It comes to its end though the client does not wait for it.
        let (state, upload, plant) = (state.clone(), upload.clone(), path.plant);
        let tasks = state.answering.clone();
        let ending = async move {
            let _taken = taken;
            bring_here(&state, &upload).await?;
            finish(&state, plant, &upload).await
        };
        tasks.spawn(ending.in_current_span()).await.map_err(|error| ApiError::internal(&error))??;
    } else {
        require_somewhere(state, &upload).await?;
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
    let concat = if upload.partial { Some("partial") } else { upload.parts.as_deref() };
    if let Some(concat) = concat.and_then(|concat| HeaderValue::from_str(concat).ok()) {
        answer.insert("upload-concat", concat);
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
    params(UploadPath),
    responses(
        (status = 200, body = UploadView),
        (status = 404, description = "`plant_not_found`, `survey_not_found`, `upload_not_found`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn get(
    State(state): State<AppState>,
    ApiPath(path): ApiPath<UploadPath>,
) -> Result<Json<UploadView>, ApiError> {
    state.require_survey(path.plant, path.survey).await?;
    let upload = require_upload(&state, path.survey, path.upload).await?;
    UploadView::of(path.plant, upload).map(Json)
}

/// What became of an upload's file, where that is known.
fn outcome(upload: &Upload) -> Result<Option<Outcome>, ApiError> {
    let outcome = upload.outcome.as_deref().map(serde_json::from_str).transpose();
    outcome.map_err(|error| ApiError::internal(&error))
}

/// End an upload and forget it (tus 1.0)
#[utoipa::path(
    delete,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads/{upload}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        UploadPath,
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
    ApiPath(path): ApiPath<UploadPath>,
    headers: HeaderMap,
) -> Response {
    answer(end(&state, &path, &headers).await)
}

async fn end(state: &AppState, path: &UploadPath, headers: &HeaderMap) -> Result<Response, ApiError> {
    let (_taken, upload) = take(state, path, headers).await?;
    state.store.delete_upload(path.survey, upload.id).await?;
    state.blobs.drop_upload(upload.id).await;
    Ok(StatusCode::NO_CONTENT.into_response())
}

/// As `PATCH` or `DELETE`, for clients that cannot send these: the header `X-HTTP-Method-Override` tells which
#[utoipa::path(
    post,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads/{upload}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        UploadPath,
        ("x-http-method-override" = String, Header, pattern = "^(PATCH|DELETE)$", description = "`PATCH` or `DELETE`")
    ),
    request_body(content = Vec<u8>, content_type = "application/offset+octet-stream", description = "The bytes"),
    responses(
        (status = 204, description = "As the method that it stands for"),
        (status = "4XX", description = "As the method that it stands for; `method_not_allowed`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn post(
    State(state): State<AppState>,
    ApiPath(path): ApiPath<UploadPath>,
    headers: HeaderMap,
    body: Body,
) -> Response {
    let method = headers.get("x-http-method-override").and_then(|value| Method::from_bytes(value.as_bytes()).ok());
    answer(match method {
        Some(Method::PATCH) => append::add(&state, &path, &headers, body).await,
        Some(Method::DELETE) => end(&state, &path, &headers).await,
        _ => Err(ApiError::new(Code::MethodNotAllowed, "send PATCH, or the header `X-HTTP-Method-Override: PATCH`")),
    })
}
