//! Whether the service runs.

use crate::http::error::{ApiError, Code, Problem};
use crate::http::state::AppState;
use axum::Json;
use axum::extract::State;
use serde::Serialize;

/// How the service is.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct Health {
    #[schema(example = "ok")]
    pub status: &'static str,
    /// The version of the program.
    #[schema(example = "0.2.0")]
    pub version: &'static str,
    /// What whoever runs the service should see to; left out where there is nothing.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schema(example = json!([]))]
    pub warnings: Vec<&'static str>,
}

const FINE: Health = Health { status: "ok", version: env!("CARGO_PKG_VERSION"), warnings: Vec::new() };

/// What is said where the worker of this process has no detector.
const NO_DETECTOR: &str = "the detector cannot be opened, so that only surveys with boxes of their own can be mapped here: \
    `heliomap doctor` tells why";

/// Whether the process runs
#[utoipa::path(get, path = "/health", tag = "operation", security(()), responses((status = 200, body = Health)))]
pub async fn health() -> Json<Health> {
    Json(FINE)
}

/// Whether database and blob store answer and can be written, and whether the process's worker has what it needs
#[utoipa::path(
    get,
    path = "/ready",
    tag = "operation",
    security(()),
    responses(
        (status = 200, body = Health),
        (status = 503, description = "`unavailable`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn ready(State(state): State<AppState>) -> Result<Json<Health>, ApiError> {
    for answer in [state.store.ping().await, state.blobs.ping().await] {
        if let Err(error) = answer {
            tracing::error!(%error, "not ready");
            return Err(ApiError::new(Code::Unavailable, "the service's storage does not answer").retry_after(5));
        }
    }
    let faults = state.writable.faults(&*state.store, &state.blobs).await;
    if !faults.is_empty() {
        let detail = format!("{}; reading still works", faults.join(", and "));
        return Err(ApiError::new(Code::Unavailable, detail).retry_after(5));
    }
    let lacks_detector = state.mapper.as_ref().is_some_and(|mapper| !mapper.has_detector());
    let warnings = lacks_detector.then_some(NO_DETECTOR).into_iter().collect();
    Ok(Json(Health { warnings, ..FINE }))
}
