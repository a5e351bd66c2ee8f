//! What a model holds, as GeoJSON (RFC 7946).

use crate::http::controllers::models::require_model;
use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::{ApiPath, ApiQuery};
use crate::http::middleware::conditional;
use crate::http::paging::{next_link, parse_cursor};
use crate::http::state::AppState;
use crate::store::{Feature, FeatureQuery, GeoBox, LayerInfo, Store};
use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use futures::stream;
use heliomap_model::{Layer, ModuleId, PlantId};
use serde::Deserialize;
use serde_json::{Map, Value, json};
use std::sync::Arc;
use uuid::Uuid;

/// The media type of GeoJSON.
const GEO_JSON: &str = "application/geo+json";
/// Most features in a part that a client asks for.
const MAX_LIMIT: u32 = 10_000;
/// Features per look into the store while a whole layer is streamed.
const CHUNK: u32 = 2_000;

/// Which features.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct FeaturesQuery {
    /// West, south, east, north, degrees: only features whose own box touches it. Where west is more than east, the box
    /// crosses the line of 180 degrees.
    #[param(example = "8.1,50.2,8.2,50.3")]
    pub bbox: Option<String>,
    /// Most features in the answer; without it, all of them.
    #[param(minimum = 1, maximum = 10000)]
    pub limit: Option<u32>,
    /// Where to go on: taken from the link to the next part.
    #[param(pattern = "^[0-9]{1,18}$")]
    pub cursor: Option<String>,
}

impl FeaturesQuery {
    fn within(&self) -> Result<Option<GeoBox>, ApiError> {
        let Some(text) = &self.bbox else { return Ok(None) };
        let wrong = |what| {
            Err(ApiError::new(Code::InvalidQuery, format!("bbox {what}: give west,south,east,north in degrees")))
        };
        let numbers: Option<Vec<f64>> =
            text.split(',').map(|part| part.trim().parse().ok().filter(|n: &f64| n.is_finite())).collect();
        let Some([min_lon, min_lat, max_lon, max_lat]) = numbers.and_then(|numbers| <[f64; 4]>::try_from(numbers).ok())
        else {
            return wrong("is not four numbers with commas between them");
        };
        if min_lat > max_lat || min_lat < -90.0 || max_lat > 90.0 {
            return wrong("has latitudes that are none or the wrong way round");
        }
        if [min_lon, max_lon].iter().any(|lon| lon.abs() > 180.0) {
            return wrong("has longitudes that are none");
        }
        let max_lon = if min_lon > max_lon { max_lon + 360.0 } else { max_lon };
        Ok(Some(GeoBox { min_lon, min_lat, max_lon, max_lat }))
    }

    fn limit(&self) -> Result<Option<u32>, ApiError> {
        match self.limit {
            Some(limit) if !(1..=MAX_LIMIT).contains(&limit) => {
                Err(ApiError::new(Code::InvalidQuery, format!("limit is {limit}; it must be 1 to {MAX_LIMIT}")))
            }
            limit => Ok(limit),
        }
    }
}

/// A layer of a model as one GeoJSON feature collection
///
/// Polygons with longitude, latitude and height. The collection says which model version, survey, reference frame and
/// vertical datum it is. Without `limit` it is whole; with it, the header `link` and the member `links` lead to the next
/// part.
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/models/{version}/{layer}",
    tag = "models",
    security(("key" = ["read"]), ("key" = ["review"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("version" = String, Path, description = "The model's version, or `latest`"),
        ("layer" = inline(LayerName), Path, description = "Which layer"),
        FeaturesQuery
    ),
    responses(
        (status = 200, body = FeatureCollection, content_type = "application/geo+json"),
        (status = "4XX", description = "`plant_not_found`, `model_not_found`, `not_found`, `invalid_query`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn layer(
    State(state): State<AppState>,
    ApiPath((plant, version, layer)): ApiPath<(PlantId, String, String)>,
    ApiQuery(query): ApiQuery<FeaturesQuery>,
) -> Result<Response, ApiError> {
    let layer: Layer = layer.parse().map_err(|error: String| ApiError::new(Code::NotFound, error))?;
    let (within, limit) = (query.within()?, query.limit()?);
    let after = query.cursor.as_deref().map(parse_cursor).transpose()?;
    let model = require_model(&state, plant, &version).await?;
    let info = state
        .store
        .layer(&model, layer)
        .await?
        .ok_or_else(|| ApiError::new(Code::NotFound, format!("the model has no layer {layer}")))?;
    let mut members: Map<String, Value> =
        serde_json::from_str(&info.properties).map_err(|error| ApiError::internal(&error))?;
    // A model never changes, so that its version and what is asked of it tell what the answer is.
    let tag = conditional::tag(format!("{} {layer} {query:?} {}", model.sha256, info.properties).as_bytes());
    let Some(limit) = limit else {
        return Ok((
            [(header::CONTENT_TYPE, GEO_JSON.to_owned()), (header::ETAG, tag)],
            whole(&state, info, members, within, after),
        )
            .into_response());
    };
    let mut features = state.store.features(&info, FeatureQuery { after, limit: limit + 1, within }).await?;
    let more = features.len() > limit as usize;
    features.truncate(limit as usize);
    let next = features.last().filter(|_| more).map(|last| {
        let place = format!("/api/v1/plants/{plant}/models/{}/{layer}", model.version);
        let bbox = query.bbox.as_ref().map(|bbox| format!("&bbox={}", bbox.replace(' ', "")));
        format!("{place}?limit={limit}&cursor={}{}", last.seq, bbox.unwrap_or_default())
    });
    members.insert("numberReturned".to_owned(), features.len().into());
    if let Some(next) = &next {
        members.insert("links".to_owned(), json!([{"rel": "next", "href": next, "type": GEO_JSON}]));
    }
    let mut body = opening(members);
    append(&mut body, &features, true);
    body.push_str("]}");
    let mut response = ([(header::CONTENT_TYPE, GEO_JSON.to_owned()), (header::ETAG, tag)], body).into_response();
    response.headers_mut().extend(next.as_deref().and_then(next_link));
    Ok(response)
}

/// A whole layer, read from the store part by part while it is sent.
fn whole(
    state: &AppState,
    layer: LayerInfo,
    members: Map<String, Value>,
    within: Option<GeoBox>,
    after: Option<i64>,
) -> Body {
    struct Rest {
        store: Arc<dyn Store>,
        layer: LayerInfo,
        query: FeatureQuery,
        opening: Option<String>,
        finished: bool,
    }
    let rest = Rest {
        store: state.store.clone(),
        layer,
        query: FeatureQuery { after, limit: CHUNK, within },
        opening: Some(opening(members)),
        finished: false,
    };
    Body::from_stream(stream::try_unfold(rest, |mut rest| async move {
        if rest.finished {
            return Ok(None);
        }
        let features = rest.store.features(&rest.layer, rest.query).await.inspect_err(|error| {
            tracing::error!(%error, "a layer broke off");
        })?;
        let first = rest.opening.is_some();
        let mut text = rest.opening.take().unwrap_or_default();
        append(&mut text, &features, first);
        rest.finished = features.len() < CHUNK as usize;
        if let Some(last) = features.last() {
            rest.query.after = Some(last.seq);
        }
        if rest.finished {
            text.push_str("]}");
        }
        Ok::<_, crate::store::StoreError>(Some((Bytes::from(text), rest)))
    }))
}

/// A collection up to its features.
fn opening(members: Map<String, Value>) -> String {
    let mut text = "{\"type\":\"FeatureCollection\",".to_owned();
    for (name, value) in members {
        text.push_str(&format!("{}:{value},", Value::String(name)));
    }
    text.push_str("\"features\":[");
    text
}

fn append(text: &mut String, features: &[Feature], first: bool) {
    for (index, feature) in features.iter().enumerate() {
        if index > 0 || !first {
            text.push(',');
        }
        text.push_str(&feature.json);
    }
}

/// Which model.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ModuleQuery {
    /// The model's version; the newest where it is not given.
    pub version: Option<u32>,
}

/// One module by its global identifier
///
/// From the newest model unless a version is given.
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/modules/{module}",
    tag = "models",
    security(("key" = ["read"]), ("key" = ["review"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("module" = Uuid, Path, description = "The module's identifier"),
        ModuleQuery
    ),
    responses(
        (status = 200, body = GeoFeature, content_type = "application/geo+json"),
        (status = "4XX", description = "`plant_not_found`, `model_not_found`, `module_not_found`, `invalid_query`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn module(
    State(state): State<AppState>,
    ApiPath((plant, module)): ApiPath<(PlantId, ModuleId)>,
    ApiQuery(query): ApiQuery<ModuleQuery>,
) -> Result<Response, ApiError> {
    let version = query.version.map_or_else(|| "latest".to_owned(), |version| version.to_string());
    let model = require_model(&state, plant, &version).await?;
    if let Some(feature) = state.store.module(&model, module).await? {
        return Ok(([(header::CONTENT_TYPE, GEO_JSON)], feature).into_response());
    }
    let detail = match state.store.module_last_seen(plant, module).await? {
        Some(seen) => format!("model {} does not hold this module; the newest that does is {seen}", model.version),
        None => "no model of this plant holds a module of that identifier".to_owned(),
    };
    Err(ApiError::new(Code::ModuleNotFound, detail))
}

/// The layers of a model.
#[derive(utoipa::ToSchema)]
#[schema(rename_all = "lowercase")]
#[expect(dead_code, reason = "it describes a parameter")]
enum LayerName {
    Modules,
    Sectors,
    Benches,
    Lines,
}

/// A GeoJSON feature collection with what it is of.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "it describes what is written from stored text")]
struct FeatureCollection {
    /// `FeatureCollection`
    #[schema(example = "FeatureCollection")]
    r#type: String,
    /// The plant's name.
    #[schema(example = "Sunfield")]
    name: String,
    plant: Uuid,
    #[schema(example = "modules")]
    layer: String,
    model_version: u32,
    /// The survey that the model was mapped from.
    #[schema(example = "5c1f4a9e-1a54-4d0e-8d6e-54d3a9be7a77")]
    survey: String,
    /// What the coordinates are and where the local frame's origin is.
    #[schema(example = json!({"crs": "EPSG:4979"}))]
    reference_frame: Value,
    /// What heights refer to.
    #[schema(example = "height above the WGS84 ellipsoid")]
    vertical_datum: String,
    /// Digest of the parameters that the model was mapped with: models of equal digests can be compared.
    #[schema(required = false, example = "9f2c1d7e40b6a853")]
    parameters: Option<String>,
    #[schema(example = json!([]))]
    warnings: Vec<Value>,
    /// With `limit`: how many features these are.
    #[schema(required = false, rename = "numberReturned")]
    number_returned: Option<u64>,
    /// With `limit`: the next part, where there is one.
    #[schema(required = false, value_type = Vec<Value>)]
    links: Option<Vec<Value>>,
    features: Vec<GeoFeature>,
}

/// A GeoJSON feature.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "it describes what is written from stored text")]
struct GeoFeature {
    /// `Feature`
    #[schema(example = "Feature")]
    r#type: String,
    /// The global identifier.
    id: Uuid,
    /// A polygon, or across the line of 180 degrees its two parts (`MultiPolygon`); positions are longitude, latitude and
    /// height.
    #[schema(example = json!({"type": "Polygon", "coordinates": [[[8.0, 50.0, 101.2], [8.00001, 50.0, 101.2], [8.00001, 50.00002, 102.0], [8.0, 50.00002, 102.0], [8.0, 50.0, 101.2]]]}))]
    geometry: Value,
    /// `id`, `label`, `plant`, the place in the plant (`line`, `bench`, `sector`, `row`, `number`), and what was measured:
    /// `center`, `tilt_deg`, `azimuth_deg`, `width_m`, `height_m`, `views`, `images`, `status`.
    #[schema(example = json!({"label": "L01-B02-R1-007", "row": 1, "number": 7, "tilt_deg": 25.0, "azimuth_deg": 180.0}))]
    properties: Value,
}
