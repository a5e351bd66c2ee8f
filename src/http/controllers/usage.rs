//! What the caller's organisation keeps, and may keep.

use crate::http::error::{ApiError, Code, Problem};
use crate::http::middleware::access::Caller;
use crate::http::state::AppState;
use crate::store::OrganisationId;
use crate::store::usage::{Quotas, UNLIMITED, Usage};
use axum::Json;
use axum::extract::State;
use jiff::Timestamp;
use serde::Serialize;

/// What an organisation keeps, and may keep.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct UsageView {
    /// Bytes of files and models; in a plant, the same bytes count once.
    pub bytes: u64,
    /// Bytes that resumable uploads announced and that are not stored yet; they count, too.
    pub announced_bytes: u64,
    /// Most bytes that it may keep; left out where there is no bound.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_bytes: Option<u64>,
    pub plants: u64,
    /// Most plants that it may have; left out where there is no bound.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_plants: Option<u64>,
}

async fn usage_of(state: &AppState, organisation: OrganisationId) -> Result<(Usage, Quotas), ApiError> {
    let usage = state.store.usage(organisation, Timestamp::now()).await?;
    let usage = usage.ok_or_else(|| ApiError::new(Code::NotFound, "the organisation is gone"))?;
    let quotas = usage.own.or(state.limits.quotas());
    let bounded = |quota: Option<u64>| quota.filter(|quota| *quota < UNLIMITED);
    Ok((usage, Quotas { bytes: bounded(quotas.bytes), plants: bounded(quotas.plants) }))
}

/// How many bytes an organisation may still send; `None` where there is no bound. Where they `may_be_there` already they may
/// count for nothing: then as many may come as if nothing was kept.
///
/// # Errors
/// Where these do not fit.
pub async fn room(
    state: &AppState,
    organisation: OrganisationId,
    bytes: u64,
    may_be_there: impl Future<Output = Result<bool, ApiError>>,
) -> Result<Option<u64>, ApiError> {
    let (usage, quotas) = usage_of(state, organisation).await?;
    let Some(quota) = quotas.bytes else { return Ok(None) };
    let used = usage.bytes.saturating_add(usage.announced_bytes);
    // What comes without a length may turn out to be too much.
    let fits = bytes > 0 && used.saturating_add(bytes) <= quota;
    if !fits && may_be_there.await? && bytes <= quota {
        return Ok(Some(quota));
    }
    match quota.checked_sub(used.saturating_add(bytes)) {
        Some(_) => Ok(Some(quota - used)),
        None => Err(over_quota("bytes", used, quota)),
    }
}

/// What is said where an organisation may not keep more.
pub fn over_quota(what: &'static str, used: u64, quota: u64) -> ApiError {
    let detail = format!(
        "the organisation keeps {used} of the {quota} {what} that it may keep, and this does not fit: delete plants that are \
         not needed, or ask whoever runs the service for a higher quota"
    );
    ApiError::new(Code::QuotaExceeded, detail).with("used", used).with("quota", quota)
}

/// What is said of an upload that turns out to be larger than what the organisation may still send.
pub fn no_room(room: u64) -> ApiError {
    let detail = format!(
        "the upload is larger than the {room} bytes that the organisation may still send: delete plants that are not needed, \
         or ask whoever runs the service for a higher quota"
    );
    ApiError::new(Code::QuotaExceeded, detail)
}

/// What the organisation keeps, and may keep
#[utoipa::path(
    get,
    path = "/api/v1/usage",
    tag = "operation",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    responses(
        (status = 200, body = UsageView),
        (status = 404, description = "`not_found`: the organisation is gone", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn get(State(state): State<AppState>, caller: Caller) -> Result<Json<UsageView>, ApiError> {
    let (usage, quotas) = usage_of(&state, caller.organisation).await?;
    Ok(Json(UsageView {
        bytes: usage.bytes,
        announced_bytes: usage.announced_bytes,
        max_bytes: quotas.bytes,
        plants: usage.plants,
        max_plants: quotas.plants,
    }))
}
