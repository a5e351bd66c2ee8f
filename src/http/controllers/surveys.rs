//! Surveys.

use crate::http::controllers::file_lists::{check_warning, cursor_after, has_warning, path_of};
use crate::http::controllers::images::{self, FileView, ImagesSummary};
use crate::http::controllers::plants::{Rename, checked_name, created_answer};
use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::{ApiJson, ApiPath, ApiQuery};
use crate::http::middleware::conditional;
use crate::http::paging::{List, filtered_list, list_limit, next_link, next_part, prefix_filter, with_filters};
use crate::http::state::AppState;
use crate::jobs;
use crate::store::{Created, FileKind, FileRecord, Survey, SurveyId};
use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use heliomap_model::PlantId;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

/// A survey to be created.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NewSurvey {
    /// What people call it; no two surveys of a plant have the same name.
    #[schema(min_length = 1, max_length = 200, example = "2026-06-21 morning")]
    pub name: String,
}

/// One flight over a plant.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct SurveyView {
    #[schema(value_type = Uuid)]
    pub id: SurveyId,
    #[schema(value_type = Uuid)]
    pub plant: PlantId,
    #[schema(example = "June 2026")]
    pub name: String,
    #[schema(value_type = String, format = DateTime)]
    pub created: Timestamp,
}

impl From<Survey> for SurveyView {
    fn from(survey: Survey) -> Self {
        Self { id: survey.id, plant: survey.plant, name: survey.name, created: survey.created }
    }
}

/// A survey with what was uploaded to it.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct SurveyDetail {
    #[serde(flatten)]
    pub survey: SurveyView,
    /// Whether it can be mapped: nothing is missing.
    pub complete: bool,
    /// What is missing before it can be mapped.
    pub missing: Vec<MissingView>,
    /// How photos and reconstruction go together.
    pub images: ImagesSummary,
    /// Sorted by path; all, or the part that was asked for.
    pub files: Vec<FileView>,
    /// The next part of the files, where there is one; also in the header `link`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(
        example = "/api/v1/plants/0b7a3f7e-59b1-4f0c-9f0d-3d6f3d1f7a11/surveys/5c1f4a9e-1a54-4d0e-8d6e-54d3a9be7a77?limit=100&cursor=aW1hZ2Vz"
    )]
    pub next: Option<String>,
}

/// Something that a survey lacks.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct MissingView {
    /// `too_few_images`, `no_reconstruction`, `no_reference` or `images_not_uploaded`.
    #[schema(example = "no_reconstruction")]
    pub code: &'static str,
    /// What is missing and what to do.
    #[schema(example = "there is no reconstruction yet")]
    pub message: String,
}

filtered_list!(
    /// Which surveys.
    SurveysQuery {
        /// Only those whose names begin so.
        #[param(max_length = 200, example = "2026-06")]
        name: String,
    }
);

/// Which files of a survey are told.
#[derive(Debug, Default, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct FilesQuery {
    /// Most files in the answer; all where it is left out.
    #[param(minimum = 1, maximum = 1000)]
    pub limit: Option<u32>,
    /// Where to go on: taken from the link to the next part.
    #[param(pattern = "^([0-9a-f]{2})+$", max_length = 800)]
    pub cursor: Option<String>,
    /// Only files of this kind: `image` or `reconstruction`.
    #[param(pattern = "^(image|reconstruction)$")]
    pub kind: Option<String>,
    /// Only files whose places in the survey's folder begin so.
    #[param(max_length = 400, example = "undistorted/")]
    pub path: Option<String>,
    /// Only files with this warning: `damaged`, `blurred`, `underexposed`, `overexposed`, `no_position`, `no_time`, `duplicate`, or
    /// `any`; or with `none`, as all have that are no photos.
    #[param(
        pattern = "^(damaged|blurred|underexposed|overexposed|no_position|no_time|duplicate|any|none)$",
        example = "any"
    )]
    pub warning: Option<String>,
}

impl FilesQuery {
    fn check(&self) -> Result<(), ApiError> {
        let kinds = [FileKind::Image, FileKind::Reconstruction].map(FileKind::as_str);
        if self.kind.as_deref().is_some_and(|kind| !kinds.contains(&kind)) {
            return Err(ApiError::new(Code::InvalidQuery, format!("kind must be {}", kinds.join(" or "))));
        }
        if self.path.as_ref().is_some_and(|path| path.chars().count() > 400) {
            return Err(ApiError::new(Code::InvalidQuery, "path is longer than 400 characters, as no place is"));
        }
        check_warning(self.warning.as_deref())
    }

    fn wants(&self, file: &FileView) -> bool {
        self.kind.as_deref().is_none_or(|kind| file.kind == kind)
            && self.path.as_deref().is_none_or(|prefix| file.path.starts_with(prefix))
            && has_warning(file, self.warning.as_deref())
    }

    /// The part that is asked for of files sorted by path, and the link to the next one.
    fn part(&self, survey: &str, mut files: Vec<FileView>) -> Result<(Vec<FileView>, Option<String>), ApiError> {
        let (limit, after) = (self.limit.map(|limit| list_limit(Some(limit))), path_of(self.cursor.as_deref())?);
        files.retain(|file| file.path > after && self.wants(file));
        let Some(limit) = limit.transpose()? else { return Ok((files, None)) };
        let more = files.len() > limit as usize;
        files.truncate(limit as usize);
        let filters = [("kind", self.kind.clone()), ("path", self.path.clone()), ("warning", self.warning.clone())];
        let next = files.last().filter(|_| more);
        let next = next.map(|last| next_part(&with_filters(survey, &filters), limit, cursor_after(&last.path)));
        Ok((files, next))
    }
}

/// What a survey with these files lacks.
pub fn missing_views(files: &[FileRecord]) -> Vec<MissingView> {
    let view = |missing: jobs::Missing| MissingView { code: missing.code, message: missing.message };
    jobs::missing(files).into_iter().map(view).collect()
}

/// Create a survey of a plant, or find the one of that name
#[utoipa::path(
    post,
    path = "/api/v1/plants/{plant}/surveys",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(("plant" = Uuid, Path, description = "The plant's identifier")),
    request_body = NewSurvey,
    responses(
        (status = 201, description = "Created", body = SurveyView, headers(("location" = String))),
        (status = 200, description = "A survey of that name was there", body = SurveyView, headers(("location" = String))),
        (status = "4XX", description = "`plant_not_found`, `invalid_json`, `invalid_fields`, `invalid_name`, \
            `unsupported_media_type`, `too_large`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn create(
    State(state): State<AppState>,
    ApiPath(plant): ApiPath<PlantId>,
    ApiJson(new): ApiJson<NewSurvey>,
) -> Result<Response, ApiError> {
    let name = checked_name(&new.name)?;
    state.require_plant(plant).await?;
    let (survey, new) = match state.store.create_survey(plant, &name, Timestamp::now()).await? {
        Created::New(survey) => (survey, true),
        Created::Existing(survey) => (survey, false),
    };
    let location = format!("/api/v1/plants/{plant}/surveys/{}", survey.id);
    Ok(created_answer(location, new, SurveyView::from(survey)))
}

/// List a plant's surveys
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/surveys",
    tag = "surveys",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(("plant" = Uuid, Path, description = "The plant's identifier"), SurveysQuery),
    responses(
        (status = 200, body = List<SurveyView>),
        (status = "4XX", description = "`plant_not_found`, `invalid_query`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn list(
    State(state): State<AppState>,
    ApiPath(plant): ApiPath<PlantId>,
    ApiQuery(query): ApiQuery<SurveysQuery>,
) -> Result<List<SurveyView>, ApiError> {
    let (part, prefix) = (query.part(), prefix_filter(query.name.as_deref())?);
    let page = part.page()?;
    state.require_plant(plant).await?;
    let surveys = state.store.surveys(plant, &prefix, page).await?;
    let path = query.path(&format!("/api/v1/plants/{plant}/surveys"));
    part.items(&path, surveys, |survey| survey.seq, SurveyView::from)
}

/// One survey: its files, and what is missing
///
/// What is missing and how photos and reconstruction go together is told of all files, whichever are listed.
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/surveys/{survey}",
    tag = "surveys",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        FilesQuery
    ),
    responses(
        (status = 200, body = SurveyDetail),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `invalid_query`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn get(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    ApiQuery(query): ApiQuery<FilesQuery>,
) -> Result<Response, ApiError> {
    query.check()?;
    let survey = state.require_survey(plant, survey).await?;
    let detail = detail(&state, survey, &query).await?;
    let link = detail.next.as_deref().and_then(next_link).map(|link| [link]);
    Ok((link, Json(detail)).into_response())
}

async fn detail(state: &AppState, survey: Survey, query: &FilesQuery) -> Result<SurveyDetail, ApiError> {
    let files = state.store.files(survey.id).await?;
    let missing = missing_views(&files);
    let (images, files) = images::summary(files);
    let (files, next) = query.part(&format!("/api/v1/plants/{}/surveys/{}", survey.plant, survey.id), files)?;
    Ok(SurveyDetail { survey: survey.into(), complete: missing.is_empty(), missing, images, files, next })
}

/// Refuses a request that is about another state of a survey than its own.
async fn require_state(state: &AppState, survey: Survey, headers: &HeaderMap) -> Result<(), ApiError> {
    match conditional::is_asked(headers) {
        true => conditional::require(headers, &detail(state, survey, &FilesQuery::default()).await?),
        false => Ok(()),
    }
}

/// Rename a survey
#[utoipa::path(
    patch,
    path = "/api/v1/plants/{plant}/surveys/{survey}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("if-match" = Option<String>, Header, description = "Only as it was when it had one of these tags")
    ),
    request_body = Rename,
    responses(
        (status = 200, description = "Renamed", body = SurveyView),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `name_taken`, `invalid_json`, `invalid_fields`, \
            `invalid_name`, `unsupported_media_type`, `too_large`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn rename(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    headers: HeaderMap,
    ApiJson(wanted): ApiJson<Rename>,
) -> Result<Json<SurveyView>, ApiError> {
    let name = checked_name(&wanted.name)?;
    require_state(&state, state.require_survey(plant, survey).await?, &headers).await?;
    Ok(Json(state.store.rename_survey(survey, &name).await?.into()))
}

/// Delete a survey with its files, uploads and jobs
///
/// A job that runs is stopped. Models that were made from it stay, with the warning `source_deleted`.
#[utoipa::path(
    delete,
    path = "/api/v1/plants/{plant}/surveys/{survey}",
    tag = "surveys",
    security(("key" = ["admin"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("if-match" = Option<String>, Header, description = "Only as it was when it had one of these tags")
    ),
    responses(
        (status = 204, description = "Nothing of it is left but models"),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "`plant_not_found`, `survey_not_found`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn delete(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    headers: HeaderMap,
) -> Result<StatusCode, ApiError> {
    require_state(&state, state.require_survey(plant, survey).await?, &headers).await?;
    for upload in state.store.delete_survey(survey, Timestamp::now()).await?.unwrap_or_default() {
        state.blobs.drop_upload(upload).await;
    }
    Ok(StatusCode::NO_CONTENT)
}
