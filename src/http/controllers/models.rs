//! Models.

use crate::http::controllers::jobs::WarningView;
use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::{ApiPath, ApiQuery};
use crate::http::paging::{List, PageQuery};
use crate::http::state::AppState;
use crate::store::{GeoBox, JobId, Model, SurveyId};
use axum::Json;
use axum::extract::State;
use heliomap_model::{Layer, PlantId};
use jiff::Timestamp;
use serde::Serialize;

/// A model of a plant.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct ModelView {
    #[schema(value_type = Uuid)]
    pub plant: PlantId,
    /// 1 for the first model of the plant, then counting up.
    pub version: u32,
    /// The survey that it was mapped from.
    #[schema(value_type = Uuid)]
    pub survey: SurveyId,
    /// The job that made it.
    #[schema(value_type = Uuid)]
    pub job: JobId,
    /// What people should know about it.
    pub warnings: Vec<WarningView>,
    #[schema(value_type = String, format = DateTime)]
    pub created: Timestamp,
}

impl From<Model> for ModelView {
    fn from(model: Model) -> Self {
        Self {
            plant: model.plant,
            version: model.version,
            survey: model.survey,
            job: model.job,
            warnings: model.warnings.into_iter().map(WarningView::from).collect(),
            created: model.created,
        }
    }
}

/// A model with what it holds.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct ModelDetail {
    #[serde(flatten)]
    pub model: ModelView,
    pub layers: Vec<LayerView>,
}

/// A layer of a model.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct LayerView {
    /// `modules`, `sectors`, `benches` or `lines`.
    #[schema(example = "modules")]
    pub layer: &'static str,
    /// How many features it holds.
    pub features: u64,
    /// West, south, east and north end, degrees; west is more than east across the line of 180 degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Vec<f64>>, min_items = 4, max_items = 4)]
    pub bbox: Option<[f64; 4]>,
    /// Where its GeoJSON is.
    #[schema(example = "/api/v1/plants/0b7a3f7e-59b1-4f0c-9f0d-3d6f3d1f7a11/models/1/modules")]
    pub href: String,
}

/// West, south, east and north; west is more than east where it crosses the line of 180 degrees (RFC 7946, 5.2).
fn bbox(extent: GeoBox) -> [f64; 4] {
    let east = if extent.max_lon > 180.0 { extent.max_lon - 360.0 } else { extent.max_lon };
    [extent.min_lon, extent.min_lat, east, extent.max_lat]
}

/// The model that a path names: a version, or `latest`.
pub async fn require_model(state: &AppState, plant: PlantId, version: &str) -> Result<Model, ApiError> {
    let asked = match version {
        "latest" => Some(None),
        number => number.parse().ok().map(Some),
    };
    let found = match asked {
        Some(version) => state.store.model(plant, version).await?,
        None => None,
    };
    if let Some(model) = found {
        return Ok(model);
    }
    state.require_plant(plant).await?;
    let detail = match state.store.model(plant, None).await? {
        None => "the plant has no model yet: map one of its surveys first".to_owned(),
        Some(newest) => format!("the plant's models are 1 to {}, and `latest` is the newest", newest.version),
    };
    Err(ApiError::new(Code::ModelNotFound, detail))
}

/// List a plant's models, the newest first
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/models",
    tag = "models",
    security(("key" = ["read"]), ("key" = ["review"])),
    params(("plant" = Uuid, Path, description = "The plant's identifier"), PageQuery),
    responses(
        (status = 200, body = List<ModelView>),
        (status = "4XX", description = "`plant_not_found`, `invalid_query`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn list(
    State(state): State<AppState>,
    ApiPath(plant): ApiPath<PlantId>,
    ApiQuery(query): ApiQuery<PageQuery>,
) -> Result<List<ModelView>, ApiError> {
    let page = query.page()?;
    state.require_plant(plant).await?;
    let models = state.store.models(plant, page).await?;
    query.items(&format!("/api/v1/plants/{plant}/models"), models, |model| model.seq, ModelView::from)
}

/// One model: what it holds and what people should know about it
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/models/{version}",
    tag = "models",
    security(("key" = ["read"]), ("key" = ["review"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("version" = String, Path, description = "The model's version, or `latest`")
    ),
    responses(
        (status = 200, body = ModelDetail),
        (status = 404, description = "`plant_not_found`, `model_not_found`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn get(
    State(state): State<AppState>,
    ApiPath((plant, version)): ApiPath<(PlantId, String)>,
) -> Result<Json<ModelDetail>, ApiError> {
    let model = require_model(&state, plant, &version).await?;
    let mut layers = Vec::new();
    for layer in Layer::ALL {
        if let Some(info) = state.store.layer(&model, layer).await? {
            layers.push(LayerView {
                layer: layer.as_str(),
                features: info.features,
                bbox: info.extent.map(bbox),
                href: format!("/api/v1/plants/{plant}/models/{}/{layer}", model.version),
            });
        }
    }
    Ok(Json(ModelDetail { model: model.into(), layers }))
}
