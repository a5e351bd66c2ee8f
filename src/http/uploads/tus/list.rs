//! A survey's uploads, so that a ground station that forgot where it was goes on with those that are not whole, and hears which
//! files were refused.

use super::{UploadState, UploadView};
use crate::http::controllers::file_lists::{cursor_after, path_of};
use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::{ApiPath, ApiQuery};
use crate::http::paging::{List, list_limit, next_part, with_filters};
use crate::http::state::AppState;
use crate::store::SurveyId;
use axum::extract::State;
use heliomap_model::PlantId;
use jiff::Timestamp;
use serde::Deserialize;

/// Uploads per look into the store where some are left out.
const CHUNK: u32 = 1000;

/// Which uploads.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct UploadsQuery {
    /// Most items in the answer.
    #[param(minimum = 1, maximum = 1000, default = 100)]
    limit: Option<u32>,
    /// Where to go on: taken from the link to the next part.
    #[param(pattern = "^([0-9a-f]{2})+$", max_length = 800)]
    cursor: Option<String>,
    /// Only those in this state: `unfinished`, `stored` or `refused`.
    #[param(pattern = "^(unfinished|stored|refused)$")]
    state: Option<String>,
}

/// List a survey's resumable uploads
///
/// Those that are not whole, and those that ended within the last 24 hours, in no order that means anything.
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads",
    tag = "surveys",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        UploadsQuery
    ),
    responses(
        (status = 200, body = List<UploadView>),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `invalid_query`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn list(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    ApiQuery(query): ApiQuery<UploadsQuery>,
) -> Result<List<UploadView>, ApiError> {
    let (limit, mut after) = (list_limit(query.limit)?, path_of(query.cursor.as_deref())?);
    let wanted: Option<UploadState> = query
        .state
        .as_deref()
        .map(str::parse)
        .transpose()
        .map_err(|()| ApiError::new(Code::InvalidQuery, "state must be one of unfinished, stored and refused"))?;
    state.require_survey(plant, survey).await?;
    let now = Timestamp::now();
    let chunk = if wanted.is_some() { CHUNK } else { limit + 1 };
    let mut items: Vec<UploadView> = Vec::new();
    // One more than is shown tells whether there is a next part.
    while items.len() <= limit as usize {
        let part = state.store.uploads_of_survey(survey, &after, chunk, now).await?;
        let Some(last) = part.last() else { break };
        after = last.id.to_string();
        for upload in part {
            let view = UploadView::of(plant, upload)?;
            if wanted.is_none_or(|wanted| view.state == wanted) {
                items.push(view);
            }
        }
    }
    let more = items.len() > limit as usize;
    items.truncate(limit as usize);
    let list = format!("/api/v1/plants/{plant}/surveys/{survey}/uploads");
    let next = items.last().filter(|_| more).map(|last| {
        next_part(&with_filters(&list, &[("state", query.state.clone())]), limit, cursor_after(&last.id.to_string()))
    });
    Ok(List { items, next })
}
