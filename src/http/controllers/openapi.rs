//! The description of the API.

use crate::http::error::ApiError;
use crate::http::router::openapi;
use axum::Json;
use axum::http::header;
use axum::response::{IntoResponse, Response};

/// The description of this API, YAML
#[utoipa::path(
    get,
    path = "/openapi.yaml",
    tag = "operation",
    security(()),
    responses((status = 200, description = "OpenAPI 3.1", content_type = "application/yaml", body = serde_json::Value))
)]
pub async fn openapi_yaml() -> Result<Response, ApiError> {
    let text = openapi().to_yaml().map_err(|error| ApiError::internal(&error))?;
    Ok(([(header::CONTENT_TYPE, "application/yaml")], text).into_response())
}

/// The description of this API, JSON
#[utoipa::path(
    get,
    path = "/openapi.json",
    tag = "operation",
    security(()),
    responses((status = 200, description = "OpenAPI 3.1", content_type = "application/json", body = serde_json::Value))
)]
pub async fn openapi_json() -> Json<utoipa::openapi::OpenApi> {
    Json(openapi())
}
