//! Uploads to a survey: photos one by one or many at once, the reconstruction file by file or as one archive.
//!
//! Bytes are streamed to disk, checked, stored under their digest, and only then entered in the survey: an upload that
//! fails leaves the survey as it was. Every upload may be repeated; the same bytes change nothing.

use crate::http::controllers::images::FileView;
use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::ApiPath;
use crate::http::middleware::conditional;
use crate::http::state::AppState;
use crate::http::uploads::form;
use crate::http::uploads::intake::archive::{self, ArchiveError, LeftOut, Unpacked};
use crate::http::uploads::intake::receive::{Bounds, drain, receive, waits_to_be_asked};
use crate::http::uploads::intake::{self, Stored};
use crate::store::{Content, Digest, FileWritten, ImageName, StagedFile, StoreError, SurveyId, SurveyPath};
use axum::Json;
use axum::body::{Body, BodyDataStream};
use axum::extract::multipart::{Field, MultipartError, MultipartRejection};
use axum::extract::{Multipart, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use heliomap_model::PlantId;
use serde::Serialize;
use std::collections::BTreeMap;
use std::time::Duration;

/// A file that was uploaded.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct UploadedFile {
    /// `created`, `replaced`, or `unchanged` where the same bytes were there.
    #[schema(example = "created")]
    pub result: &'static str,
    #[serde(flatten)]
    pub file: FileView,
}

/// Files that were uploaded together.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct UploadedFiles {
    pub files: Vec<UploadedFile>,
}

/// The files of an archive that was uploaded.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct UploadedArchive {
    pub files: Vec<UploadedFile>,
    /// How many of its entries were not taken.
    pub ignored_count: usize,
    /// The first few of them.
    #[schema(example = json!(["odm_report/report.pdf"]))]
    pub ignored: Vec<String>,
    /// All of them that look like a photo or a part of a reconstruction, with the reason.
    pub left_out: Vec<LeftOut>,
}

/// A file that was stored, as it is told.
pub fn uploaded(stored: Stored) -> UploadedFile {
    let result = match stored.written {
        FileWritten::Created => "created",
        FileWritten::Replaced => "replaced",
        FileWritten::Unchanged => "unchanged",
    };
    UploadedFile { result, file: FileView::new(stored.record, &stored.twins) }
}

/// Upload one photo
///
/// The body is the image file. Uploading the same bytes again changes nothing.
#[utoipa::path(
    put,
    path = "/api/v1/plants/{plant}/surveys/{survey}/images/{name}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("name" = String, Path, description = "The photo's file name, as the reconstruction names it"),
        ("if-match" = Option<String>, Header, description = "Only over a file with one of these tags; `*` over any"),
        ("if-none-match" = Option<String>, Header, description = "Only where no file with one of these tags is; `*`: none at all")
    ),
    request_body(content = Vec<u8>, content_type = "application/octet-stream", description = "A JPEG, PNG or TIFF file"),
    responses(
        (status = 201, description = "Created", body = UploadedFile, headers(("etag" = String))),
        (status = 200, description = "Replaced, or unchanged", body = UploadedFile, headers(("etag" = String))),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `invalid_name`, `too_large`, `image_too_large`, \
            `image_format_mismatch`, `image_unreadable`, `image_truncated`, `upload_interrupted`, `upload_stalled`, \
            `bad_request`, `unsupported_media_type` (a coded body), `checksum_mismatch`", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "`storage_full`, `quota_exceeded`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn put_image(
    State(state): State<AppState>,
    ApiPath((plant, survey, name)): ApiPath<(PlantId, SurveyId, String)>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let place = ImageName::parse(&name).map(|name| SurveyPath::of_image(&name));
    put_one(&state, plant, survey, place.map_err(ApiError::from), &headers, body).await
}

/// Upload one file of the reconstruction
///
/// `path` is its place in OpenSfM's folder: `reconstruction.json`, `reference_lla.json`, `camera_models.json`,
/// `undistorted/reconstruction.json`, `undistorted/undistorted_shot_ids.json`, `undistorted/images/NAME`,
/// `undistorted/depthmaps/merged.ply`. Beside these, `boxes.json`: boxes that another program made or a person corrected, in
/// the form that `heliomap detect` writes (pixels of the undistorted images, corners in any order); the survey is then mapped
/// from them, and no detector runs.
#[utoipa::path(
    put,
    path = "/api/v1/plants/{plant}/surveys/{survey}/reconstruction/{*path}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("path" = String, Path, description = "The file's place in OpenSfM's folder"),
        ("if-match" = Option<String>, Header, description = "Only over a file with one of these tags; `*` over any"),
        ("if-none-match" = Option<String>, Header, description = "Only where no file with one of these tags is; `*`: none at all")
    ),
    request_body(content = Vec<u8>, content_type = "application/octet-stream", description = "The file"),
    responses(
        (status = 201, description = "Created", body = UploadedFile, headers(("etag" = String))),
        (status = 200, description = "Replaced, or unchanged", body = UploadedFile, headers(("etag" = String))),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `unknown_file`, `invalid_name`, `too_large`, \
            `file_unreadable`, `reconstruction_malformed`, `reconstruction_not_finite`, `camera_model_unknown`, \
            `too_few_images`, `point_cloud_empty`, `point_cloud_truncated`, `point_cloud_too_large`, `boxes_invalid`, `image_too_large`, `image_format_mismatch`, `image_unreadable`, `image_truncated`, \
            `upload_interrupted`, `upload_stalled`, `bad_request`, `unsupported_media_type` (a coded body), \
            `checksum_mismatch`", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "`storage_full`, `quota_exceeded`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn put_reconstruction_file(
    State(state): State<AppState>,
    ApiPath((plant, survey, path)): ApiPath<(PlantId, SurveyId, String)>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let place = SurveyPath::of_reconstruction(&path).map_err(ApiError::from);
    put_one(&state, plant, survey, place, &headers, body).await
}

async fn put_one(
    state: &AppState,
    plant: PlantId,
    survey: SurveyId,
    place: Result<SurveyPath, ApiError>,
    headers: &HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let mut body = body.into_data_stream();
    let mut is_asked_for = !waits_to_be_asked(headers);
    let stored = async {
        let place = place?;
        let wanted = conditional::wanted(headers);
        state.require_survey(plant, survey).await?;
        if let Some(wanted) = &wanted {
            let there = state.store.file(survey, &place).await?.map(|file| file.sha256);
            if !wanted.holds(there) {
                return Err(conditional::failed());
            }
        }
        let limit = match place.content() {
            Content::Image => state.limits.max_image_size,
            Content::Json { .. } | Content::Ply | Content::Text => state.limits.max_file_size,
        };
        require_within(place.as_str(), limit, headers)?;
        is_asked_for = true;
        let staged = receive_body(state, place.as_str(), limit, headers, &mut body).await?;
        let checked = intake::check(state, plant, place, staged).await?;
        intake::store(state, plant, survey, vec![checked], wanted.as_ref()).await
    };
    match stored.await {
        Ok(stored) => {
            let new = stored.iter().any(|stored| stored.written == FileWritten::Created);
            let status = if new { StatusCode::CREATED } else { StatusCode::OK };
            let tag = stored.first().map(|stored| [(header::ETAG, conditional::file_tag(stored.record.sha256))]);
            let file = stored.into_iter().next().map(uploaded);
            Ok((status, tag, Json(file)).into_response())
        }
        Err(problem) => {
            if is_asked_for {
                drain(&mut body, &problem).await;
            }
            Err(problem)
        }
    }
}

/// Refuses a body that says that it is larger.
fn require_within(name: &str, max_bytes: u64, headers: &HeaderMap) -> Result<(), ApiError> {
    let announced = headers.get(header::CONTENT_LENGTH).and_then(|value| value.to_str().ok()?.parse::<u64>().ok());
    match announced {
        Some(length) if length > max_bytes => Err(intake::too_large(name, max_bytes)),
        _ => Ok(()),
    }
}

/// Streams a whole body to disk.
async fn receive_body(
    state: &AppState,
    name: &str,
    max_bytes: u64,
    headers: &HeaderMap,
    body: &mut BodyDataStream,
) -> Result<StagedFile, ApiError> {
    let bounds = Bounds { name, max_bytes, idle: state.limits.request_timeout };
    let staged = receive(body, state.blobs.staging(), bounds).await?;
    intake::digest::require(headers, &staged.sha256)?;
    Ok(staged)
}

/// Upload many photos at once
///
/// A `multipart/form-data` body in which every part with a file name is a photo. Each photo is checked and stored on
/// its own: where some are refused, the answer is a problem document with the members `files` (what was stored) and
/// `refused` (a problem document for each that was not, with its name), and only those need be sent again.
#[utoipa::path(
    post,
    path = "/api/v1/plants/{plant}/surveys/{survey}/images",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier")
    ),
    request_body(content = inline(PhotoForm), content_type = "multipart/form-data"),
    responses(
        (status = 200, description = "All stored", body = UploadedFiles),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `files_refused` (of its files also `name_twice`), `bad_request`, \
            `upload_interrupted`, `upload_stalled`, `unsupported_media_type`, `too_large`", body = Problem,
            content_type = "application/problem+json"),
        (status = 507, description = "`storage_full`, `quota_exceeded`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn post_images(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    headers: HeaderMap,
    form: Result<Multipart, MultipartRejection>,
) -> Result<Json<UploadedFiles>, ApiError> {
    conditional::refuse(&headers, "several files")?;
    let mut form = form.map_err(|_| {
        ApiError::new(
            Code::UnsupportedMediaType,
            "send multipart/form-data with a boundary, as `curl -F file=@DJI_0001.jpg -F file=@DJI_0002.jpg` does",
        )
    })?;
    state.require_survey(plant, survey).await?;
    let mut files = Vec::new();
    let mut refused = Vec::new();
    let mut parts = 0;
    // What came under each name.
    let mut digests: BTreeMap<SurveyPath, Digest> = BTreeMap::new();
    let idle = state.limits.request_timeout;
    loop {
        let next = in_time(idle, form.next_field()).await;
        let Some(mut part) = next.map_err(|problem| so_far(problem, &files, &refused))? else { break };
        let Some(name) = form::file_name(part.headers()) else {
            skip(idle, &mut part).await.map_err(|problem| so_far(problem, &files, &refused))?;
            continue;
        };
        parts += 1;
        if parts > state.limits.max_entries {
            let detail = format!("the form has more than {} files; send the rest in another", state.limits.max_entries);
            return Err(so_far(ApiError::new(Code::TooLarge, detail), &files, &refused));
        }
        let stored = async {
            let place = SurveyPath::of_image(&ImageName::parse(&name)?);
            form::require_as_it_is(part.headers())?;
            let bounds = Bounds { name: place.as_str(), max_bytes: state.limits.max_image_size, idle };
            let staged = receive(&mut part, state.blobs.staging(), bounds).await?;
            if digests.get(&place).is_some_and(|digest| *digest != staged.sha256) {
                let what =
                    format!("the form brought another file as {name} before, which was kept: give each its own name");
                return Err(ApiError::new(Code::NameTwice, what));
            }
            digests.insert(place.clone(), staged.sha256);
            let checked = intake::check(&state, plant, place, staged).await?;
            intake::store(&state, plant, survey, vec![checked], None).await
        };
        match stored.await {
            Ok(stored) => files.extend(stored.into_iter().map(uploaded)),
            // The connection or the service failed, not this file: the next would fare no better.
            Err(problem)
                if problem.code.parts().0.is_server_error()
                    || matches!(problem.code, Code::UploadInterrupted | Code::UploadStalled) =>
            {
                return Err(so_far(problem, &files, &refused));
            }
            Err(problem) => {
                refused.push(problem.with("name", name).document());
                skip(idle, &mut part).await.map_err(|problem| so_far(problem, &files, &refused))?;
            }
        }
    }
    if !refused.is_empty() {
        let detail = format!(
            "{} of {parts} files were refused, the others are stored; `refused` says why and what to do",
            refused.len()
        );
        return Err(ApiError::new(Code::FilesRefused, detail).with("files", files).with("refused", refused));
    }
    if files.is_empty() {
        return Err(ApiError::new(
            Code::BadRequest,
            "the form holds no file: give each photo a part with a file name, as `curl -F file=@DJI_0001.jpg` does",
        ));
    }
    Ok(Json(UploadedFiles { files }))
}

/// What a form brings next, which may take a while, but not stand still.
async fn in_time<T>(idle: Duration, next: impl Future<Output = Result<T, MultipartError>>) -> Result<T, ApiError> {
    match tokio::time::timeout(idle, next).await {
        Ok(Ok(next)) => Ok(next),
        Ok(Err(error)) => {
            Err(ApiError::new(Code::BadRequest, format!("the form cannot be read: {}", error.body_text())))
        }
        Err(_) => Err(ApiError::new(Code::UploadStalled, "the form stood still; send what is not stored yet again")),
    }
}

/// Takes the rest of a part that is not wanted off the line, however long that takes.
async fn skip(idle: Duration, part: &mut Field<'_>) -> Result<(), ApiError> {
    while in_time(idle, part.chunk()).await?.is_some() {}
    Ok(())
}

/// A problem that ends a form, with what became of its files so far.
fn so_far(problem: ApiError, files: &[UploadedFile], refused: &[serde_json::Value]) -> ApiError {
    problem.with("files", files).with("refused", refused)
}

/// A form of photos.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "it describes a form that is read part by part")]
struct PhotoForm {
    /// The photos; the name of the part does not matter, the file name does.
    #[schema(value_type = Vec<String>, format = Binary)]
    file: Vec<Vec<u8>>,
}

/// Upload a reconstruction as one zip, tar or tar.gz
///
/// The archive holds OpenSfM's folder or what is in it, or ODM's project, photos included if you like; photos may lie in
/// folders below `images/`. All of its known files are stored or, where one is refused, none; of the others, `left_out`
/// names those that look like a photo or a part of a reconstruction.
#[utoipa::path(
    put,
    path = "/api/v1/plants/{plant}/surveys/{survey}/reconstruction",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier")
    ),
    request_body(content = Vec<u8>, content_type = "application/octet-stream", description = "A zip, tar or gzipped tar"),
    responses(
        (status = 200, description = "All stored", body = UploadedArchive),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `unsupported_archive`, `archive_unsafe`, \
            `archive_unreadable`, `archive_empty`, `archive_too_large`, `too_large`, `invalid_name`, `file_unreadable`, `reconstruction_malformed`, `reconstruction_not_finite`, `camera_model_unknown`, \
            `too_few_images`, `point_cloud_empty`, `point_cloud_truncated`, `point_cloud_too_large`, `boxes_invalid`, \
            `image_too_large`, `image_format_mismatch`, `image_unreadable`, `image_truncated`, `upload_interrupted`, \
            `upload_stalled`, `bad_request`, `unsupported_media_type` (a coded body), `checksum_mismatch`", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "`storage_full`, `quota_exceeded`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn put_reconstruction(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    headers: HeaderMap,
    body: Body,
) -> Result<Json<UploadedArchive>, ApiError> {
    let mut body = body.into_data_stream();
    let mut is_asked_for = !waits_to_be_asked(&headers);
    let stored = async {
        conditional::refuse(&headers, "an archive")?;
        state.require_survey(plant, survey).await?;
        let limit = state.limits.max_archive_size;
        require_within("the archive", limit, &headers)?;
        is_asked_for = true;
        let archive = receive_body(&state, "the archive", limit, &headers, &mut body).await?;
        store_archive(&state, plant, survey, archive).await.map(Json)
    };
    let stored: Result<_, ApiError> = stored.await;
    if let Err(problem) = &stored
        && is_asked_for
    {
        drain(&mut body, problem).await;
    }
    stored
}

/// As `PUT`
#[utoipa::path(
    post,
    path = "/api/v1/plants/{plant}/surveys/{survey}/reconstruction",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier")
    ),
    request_body(content = Vec<u8>, content_type = "application/octet-stream", description = "A zip, tar or gzipped tar"),
    responses(
        (status = 200, description = "All stored", body = UploadedArchive),
        (status = "4XX", description = "As `PUT`", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "`storage_full`, `quota_exceeded`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn post_reconstruction(
    state: State<AppState>,
    path: ApiPath<(PlantId, SurveyId)>,
    headers: HeaderMap,
    body: Body,
) -> Result<Json<UploadedArchive>, ApiError> {
    put_reconstruction(state, path, headers, body).await
}

/// Stores the known files of an archive, all or none.
pub async fn store_archive(
    state: &AppState,
    plant: PlantId,
    survey: SurveyId,
    archive: StagedFile,
) -> Result<UploadedArchive, ApiError> {
    let Unpacked { files, ignored, ignored_count, left_out } = unpack(state, archive).await?;
    let mut checked = Vec::with_capacity(files.len());
    for (place, staged) in files {
        let limit = match place.content() {
            Content::Image => state.limits.max_image_size,
            Content::Json { .. } | Content::Ply | Content::Text => state.limits.max_file_size,
        };
        if staged.size > limit {
            return Err(intake::too_large(place.as_str(), limit));
        }
        checked.push(intake::check(state, plant, place, staged).await?);
    }
    let files = intake::store(state, plant, survey, checked, None).await?.into_iter().map(uploaded).collect();
    Ok(UploadedArchive { files, ignored_count, ignored, left_out })
}

async fn unpack(state: &AppState, archive: StagedFile) -> Result<Unpacked, ApiError> {
    let (folder, limits) = (state.blobs.staging().to_owned(), state.limits.clone());
    let work = tokio::task::spawn_blocking(move || archive::unpack(&archive.path, &folder, &limits));
    let unpacked = work.await.map_err(|error| ApiError::internal(&error))?;
    unpacked.map_err(|error| {
        let code = match &error {
            ArchiveError::Unknown | ArchiveError::OtherKind { .. } => Code::UnsupportedArchive,
            ArchiveError::Unreadable(_) => Code::ArchiveUnreadable,
            ArchiveError::Unsafe { .. } | ArchiveError::Twice { .. } | ArchiveError::SameName { .. } => {
                Code::ArchiveUnsafe
            }
            ArchiveError::TooLarge { .. } => Code::ArchiveTooLarge,
            ArchiveError::Name { .. } => Code::InvalidName,
            ArchiveError::NothingKnown { .. } => Code::ArchiveEmpty,
            ArchiveError::Disk(_) => {
                let ArchiveError::Disk(source) = error else { return ApiError::internal(&error) };
                let path = state.blobs.staging().to_owned();
                return StoreError::Io { action: "unpack into", path, source }.into();
            }
        };
        ApiError::new(code, error.to_string())
    })
}
