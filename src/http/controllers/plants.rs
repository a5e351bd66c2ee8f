//! Plants.

use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::{ApiJson, ApiPath, ApiQuery};
use crate::http::middleware::access::Caller;
use crate::http::middleware::conditional;
use crate::http::paging::{List, filtered_list, prefix_filter};
use crate::http::state::AppState;
use crate::store::{Created, Page, Plant, name};
use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use heliomap_model::PlantId;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

/// A plant to be created.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NewPlant {
    /// What people call it; no two plants of an organisation have the same name.
    #[schema(min_length = 1, max_length = 200, example = "Sunfield North")]
    pub name: String,
}

/// A photovoltaic plant.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct PlantView {
    #[schema(value_type = Uuid)]
    pub id: PlantId,
    #[schema(example = "Sunfield")]
    pub name: String,
    #[schema(value_type = String, format = DateTime)]
    pub created: Timestamp,
}

impl From<Plant> for PlantView {
    fn from(plant: Plant) -> Self {
        Self { id: plant.id, name: plant.name, created: plant.created }
    }
}

/// Reads a name that people give.
pub fn checked_name(name: &str) -> Result<String, ApiError> {
    name::checked(name).map_err(|error| ApiError::new(Code::InvalidName, error.to_string()))
}

filtered_list!(
    /// Which plants.
    PlantsQuery {
        /// Only those whose names begin so.
        #[param(max_length = 200, example = "Sunfield")]
        name: String,
    }
);

/// The answer to a creation: 201 with its place, or 200 where it was there already.
pub fn created_answer<T: Serialize>(location: String, new: bool, view: T) -> Response {
    let status = if new { StatusCode::CREATED } else { StatusCode::OK };
    (status, [(header::LOCATION, location)], Json(view)).into_response()
}

/// Create a plant, or find the one of that name
///
/// A key that is good for some plants finds these, and creates none.
#[utoipa::path(
    post,
    path = "/api/v1/plants",
    tag = "plants",
    security(("key" = ["upload"])),
    request_body = NewPlant,
    responses(
        (status = 201, description = "Created", body = PlantView, headers(("location" = String))),
        (status = 200, description = "A plant of that name was there", body = PlantView, headers(("location" = String))),
        (status = "4XX", description = "`invalid_json`, `invalid_fields`, `invalid_name`, `unsupported_media_type`, `too_large`",
            body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "`quota_exceeded`: the organisation has as many plants as it may", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn create(
    State(state): State<AppState>,
    caller: Caller,
    ApiJson(new): ApiJson<NewPlant>,
) -> Result<Response, ApiError> {
    let name = checked_name(&new.name)?;
    if let Some(plants) = &caller.plants {
        let page = Page { after: None, limit: plants.len() as u32 };
        let plants = state.store.plants(caller.organisation, Some(plants), &name, page).await?;
        if let Some(plant) = plants.into_iter().find(|plant| plant.name == name) {
            return Ok(created_answer(format!("/api/v1/plants/{}", plant.id), false, PlantView::from(plant)));
        }
    }
    caller.require_all_plants()?;
    let quotas = state.limits.quotas();
    let (plant, new) = match state.store.create_plant(caller.organisation, &name, quotas, Timestamp::now()).await? {
        Created::New(plant) => (plant, true),
        Created::Existing(plant) => (plant, false),
    };
    Ok(created_answer(format!("/api/v1/plants/{}", plant.id), new, PlantView::from(plant)))
}

/// List plants
#[utoipa::path(
    get,
    path = "/api/v1/plants",
    tag = "plants",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(PlantsQuery),
    responses(
        (status = 200, body = List<PlantView>),
        (status = 400, description = "`invalid_query`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn list(
    State(state): State<AppState>,
    caller: Caller,
    ApiQuery(query): ApiQuery<PlantsQuery>,
) -> Result<List<PlantView>, ApiError> {
    let (part, prefix) = (query.part(), prefix_filter(query.name.as_deref())?);
    let plants = state.store.plants(caller.organisation, caller.plants.as_deref(), &prefix, part.page()?).await?;
    part.items(&query.path("/api/v1/plants"), plants, |plant| plant.seq, PlantView::from)
}

/// One plant
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}",
    tag = "plants",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(("plant" = Uuid, Path, description = "The plant's identifier")),
    responses(
        (status = 200, body = PlantView),
        (status = 404, description = "`plant_not_found`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn get(State(state): State<AppState>, ApiPath(plant): ApiPath<PlantId>) -> Result<Json<PlantView>, ApiError> {
    Ok(Json(state.require_plant(plant).await?.into()))
}

/// What is changed of a plant or survey.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Rename {
    /// Its new name.
    #[schema(min_length = 1, max_length = 200, example = "Sunfield South")]
    pub name: String,
}

/// Rename a plant
#[utoipa::path(
    patch,
    path = "/api/v1/plants/{plant}",
    tag = "plants",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("if-match" = Option<String>, Header, description = "Only as it was when it had one of these tags")
    ),
    request_body = Rename,
    responses(
        (status = 200, description = "Renamed", body = PlantView),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = "4XX", description = "`plant_not_found`, `name_taken`, `invalid_json`, `invalid_fields`, `invalid_name`, \
            `unsupported_media_type`, `too_large`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn rename(
    State(state): State<AppState>,
    ApiPath(plant): ApiPath<PlantId>,
    headers: HeaderMap,
    ApiJson(wanted): ApiJson<Rename>,
) -> Result<Json<PlantView>, ApiError> {
    let name = checked_name(&wanted.name)?;
    conditional::require(&headers, &PlantView::from(state.require_plant(plant).await?))?;
    Ok(Json(state.store.rename_plant(plant, &name).await?.into()))
}

/// Delete a plant with its surveys, files, jobs and models
///
/// A job that runs is stopped.
#[utoipa::path(
    delete,
    path = "/api/v1/plants/{plant}",
    tag = "plants",
    security(("key" = ["admin"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("if-match" = Option<String>, Header, description = "Only as it was when it had one of these tags")
    ),
    responses(
        (status = 204, description = "Nothing of it is left"),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "`plant_not_found`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn delete(
    State(state): State<AppState>,
    ApiPath(plant): ApiPath<PlantId>,
    headers: HeaderMap,
) -> Result<StatusCode, ApiError> {
    if conditional::is_asked(&headers) {
        conditional::require(&headers, &PlantView::from(state.require_plant(plant).await?))?;
    }
    let uploads = state.store.uploads_of_plant(plant).await?;
    state.store.delete_plant(plant, Timestamp::now()).await?;
    for upload in uploads {
        state.blobs.drop_upload(upload).await;
    }
    state.blobs.delete_plant(plant).await?;
    Ok(StatusCode::NO_CONTENT)
}
