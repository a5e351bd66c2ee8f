//! Deleting files of a survey: photos that were uploaded by mistake, parts of a reconstruction.

use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::ApiPath;
use crate::http::middleware::conditional;
use crate::http::state::AppState;
use crate::store::{FileDeleted, ImageName, InvalidPath, SurveyId, SurveyPath};
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use heliomap_model::PlantId;
use jiff::Timestamp;

/// Delete a photo
///
/// A job that runs goes on with the photos that it began with. Models that were made from it stay, with the warning
/// `source_deleted`.
#[utoipa::path(
    delete,
    path = "/api/v1/plants/{plant}/surveys/{survey}/images/{name}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("name" = String, Path, description = "The photo's file name"),
        ("if-match" = Option<String>, Header, description = "Only a file with one of these tags")
    ),
    responses(
        (status = 204, description = "Deleted"),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "`plant_not_found`, `survey_not_found`, `file_not_found`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn delete_image(
    State(state): State<AppState>,
    ApiPath((plant, survey, name)): ApiPath<(PlantId, SurveyId, String)>,
    headers: HeaderMap,
) -> Result<StatusCode, ApiError> {
    let place = ImageName::parse(&name).map(|name| SurveyPath::of_image(&name));
    delete(&state, plant, survey, place, &headers).await
}

/// Delete one file of the reconstruction
///
/// As a photo's.
#[utoipa::path(
    delete,
    path = "/api/v1/plants/{plant}/surveys/{survey}/reconstruction/{*path}",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("path" = String, Path, description = "The file's place in OpenSfM's folder"),
        ("if-match" = Option<String>, Header, description = "Only a file with one of these tags")
    ),
    responses(
        (status = 204, description = "Deleted"),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "`plant_not_found`, `survey_not_found`, `file_not_found`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn delete_reconstruction_file(
    State(state): State<AppState>,
    ApiPath((plant, survey, path)): ApiPath<(PlantId, SurveyId, String)>,
    headers: HeaderMap,
) -> Result<StatusCode, ApiError> {
    delete(&state, plant, survey, SurveyPath::of_reconstruction(&path), &headers).await
}

async fn delete(
    state: &AppState,
    plant: PlantId,
    survey: SurveyId,
    place: Result<SurveyPath, InvalidPath>,
    headers: &HeaderMap,
) -> Result<StatusCode, ApiError> {
    let survey = state.require_survey(plant, survey).await?;
    let absent = || {
        let detail =
            format!("the survey has no such file; GET /api/v1/plants/{plant}/surveys/{} lists them", survey.id);
        ApiError::new(Code::FileNotFound, detail)
    };
    // What can be no name is none of a file.
    let place = place.map_err(|_| absent())?;
    let wanted = conditional::wanted(headers);
    match state.store.delete_file(survey.id, &place, wanted.as_ref(), Timestamp::now()).await? {
        FileDeleted::Deleted => Ok(StatusCode::NO_CONTENT),
        FileDeleted::Absent => Err(absent()),
        FileDeleted::Other => Err(conditional::failed()),
    }
}
