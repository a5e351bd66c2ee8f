//! Keys and the audit log of the caller's organisation.

use crate::http::controllers::plants::checked_name;
use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::{ApiJson, ApiPath, ApiQuery};
use crate::http::middleware::access::Caller;
use crate::http::middleware::conditional;
use crate::http::paging::{List, filtered_list};
use crate::http::state::AppState;
use crate::store::{ApiKey, AuditEntry, KeyId, NewKey, Scope, Secret, TimeSpan};
use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use heliomap_model::PlantId;
use jiff::{SignedDuration, Timestamp};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// How long a rotated key's previous secret may stay good.
const MAX_GRACE: SignedDuration = SignedDuration::from_hours(30 * 24);
/// Most plants that a key may be limited to.
const MAX_PLANTS: usize = 1000;

/// A key to be created.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CreateKey {
    /// What people call it.
    #[schema(min_length = 1, max_length = 200, example = "ground station 7")]
    pub name: String,
    /// What it is good for.
    #[schema(min_items = 1, value_type = Vec<Scope>)]
    pub scopes: BTreeSet<Scope>,
    /// The plants that it is good for; all of the organisation's, those to come included, where it is left out.
    #[schema(min_items = 1, max_items = 1000, value_type = Option<Vec<Uuid>>)]
    pub plants: Option<Vec<PlantId>>,
    /// When it ends; never where it is left out.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub expires: Option<Timestamp>,
}

/// How a key is rotated.
#[derive(Debug, Default, Deserialize, utoipa::ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RotateKey {
    /// Seconds for which the secret so far stays good, up to 30 days; none where it is left out.
    #[schema(maximum = 2592000)]
    pub grace_s: u32,
}

/// A key, without its secret.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct KeyView {
    #[schema(value_type = Uuid)]
    pub id: KeyId,
    #[schema(example = "flight")]
    pub name: String,
    /// How its secret begins.
    #[schema(example = "hm_1f0c93ab")]
    pub prefix: String,
    #[schema(value_type = Vec<Scope>)]
    pub scopes: BTreeSet<Scope>,
    /// The plants that it is good for; all where it is left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Vec<Uuid>>)]
    pub plants: Option<Vec<PlantId>>,
    #[schema(value_type = String, format = DateTime)]
    pub created: Timestamp,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    pub expires: Option<Timestamp>,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    pub revoked: Option<Timestamp>,
    /// When it was last used, exact to a minute.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    pub last_used: Option<Timestamp>,
}

/// A key with its secret, which is shown this once.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct KeyWithSecret {
    /// What clients send as `authorization: Bearer …`.
    #[schema(example = "helio_shown-this-once-only")]
    pub secret: String,
    #[serde(flatten)]
    pub key: KeyView,
}

impl From<ApiKey> for KeyView {
    fn from(key: ApiKey) -> Self {
        Self {
            id: key.id,
            name: key.name,
            prefix: key.prefix,
            scopes: key.scopes,
            plants: key.plants,
            created: key.created,
            expires: key.expires,
            revoked: key.revoked,
            last_used: key.last_used,
        }
    }
}

filtered_list!(
    /// Which keys.
    KeysQuery {
        /// Only those made at this time or after it.
        #[param(value_type = Option<String>, format = DateTime)]
        since: Timestamp,
        /// Only those made before this time.
        #[param(value_type = Option<String>, format = DateTime)]
        until: Timestamp,
    }
);
filtered_list!(
    /// Which entries of the log.
    AuditQuery {
        /// Only those of this time or after it.
        #[param(value_type = Option<String>, format = DateTime)]
        since: Timestamp,
        /// Only those before this time.
        #[param(value_type = Option<String>, format = DateTime)]
        until: Timestamp,
    }
);

fn no_key(id: KeyId) -> ApiError {
    ApiError::new(Code::KeyNotFound, format!("no key has the identifier {id}; GET /api/v1/keys lists them"))
}

/// The key that a request changes, as the caller saw it, by the beginning of its secret; nothing where the request does not
/// say which state of it is meant.
async fn as_seen(
    state: &AppState,
    caller: &Caller,
    id: KeyId,
    headers: &HeaderMap,
) -> Result<Option<String>, ApiError> {
    if !conditional::is_asked(headers) {
        return Ok(None);
    }
    let key = state.store.key(caller.organisation, id).await?.ok_or_else(|| no_key(id))?;
    let prefix = key.prefix.clone();
    conditional::require(headers, &KeyView::from(key))?;
    Ok(Some(prefix))
}

/// What is said where a key is not there, or is not the one that was seen a moment before.
fn not_as_seen(seen: Option<&str>, id: KeyId) -> ApiError {
    if seen.is_some() { conditional::failed() } else { no_key(id) }
}

fn new_secret() -> Result<Secret, ApiError> {
    Secret::random().map_err(|error| ApiError::internal(&error))
}

/// Create a key
///
/// Its secret is in the answer and nowhere else.
#[utoipa::path(
    post,
    path = "/api/v1/keys",
    tag = "access",
    security(("key" = ["admin"])),
    request_body = CreateKey,
    responses(
        (status = 201, description = "Created", body = KeyWithSecret, headers(("location" = String))),
        (status = "4XX", description = "`invalid_json`, `invalid_fields`, `invalid_name`, `plant_not_found`, \
            `unsupported_media_type`, `too_large`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn create(
    State(state): State<AppState>,
    caller: Caller,
    ApiJson(asked): ApiJson<CreateKey>,
) -> Result<Response, ApiError> {
    caller.require_all_plants()?;
    let refuse = |what: &'static str| Err(ApiError::new(Code::InvalidFields, what));
    let now = Timestamp::now();
    if asked.scopes.is_empty() {
        return refuse("scopes must name at least one of upload, read, review, admin");
    }
    if asked.plants.as_ref().is_some_and(|plants| plants.is_empty() || plants.len() > MAX_PLANTS) {
        return refuse("plants must be 1 to 1000 identifiers; leave it out for all plants");
    }
    if asked.expires.is_some_and(|expires| expires <= now) {
        return refuse("expires must lie ahead; leave it out for a key that never ends");
    }
    for plant in asked.plants.iter().flatten() {
        let found = state.store.plant(*plant).await?;
        found.filter(|found| found.organisation == caller.organisation).ok_or_else(|| AppState::no_plant(*plant))?;
    }
    let secret = new_secret()?;
    let new = NewKey {
        organisation: caller.organisation,
        name: checked_name(&asked.name)?,
        secret: secret.record(),
        scopes: asked.scopes,
        plants: asked.plants,
        expires: asked.expires,
    };
    let key = state.store.create_key(&new, now).await?;
    let location = format!("/api/v1/keys/{}", key.id);
    let answer = KeyWithSecret { secret: secret.reveal().to_owned(), key: key.into() };
    Ok((StatusCode::CREATED, [(header::LOCATION, location)], Json(answer)).into_response())
}

/// List keys, revoked and expired ones included
#[utoipa::path(
    get,
    path = "/api/v1/keys",
    tag = "access",
    security(("key" = ["admin"])),
    params(KeysQuery),
    responses(
        (status = 200, body = List<KeyView>),
        (status = 400, description = "`invalid_query`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn list(
    State(state): State<AppState>,
    caller: Caller,
    ApiQuery(query): ApiQuery<KeysQuery>,
) -> Result<List<KeyView>, ApiError> {
    caller.require_all_plants()?;
    let (part, made) = (query.part(), TimeSpan { since: query.since, until: query.until });
    let keys = state.store.keys(Some(caller.organisation), made, part.page()?).await?;
    part.items(&query.path("/api/v1/keys"), keys, |key| key.seq, KeyView::from)
}

/// One key
///
/// Its tag changes with the time of its last use, too.
#[utoipa::path(
    get,
    path = "/api/v1/keys/{key}",
    tag = "access",
    security(("key" = ["admin"])),
    params(("key" = Uuid, Path, description = "The key's identifier")),
    responses(
        (status = 200, body = KeyView),
        (status = 404, description = "`key_not_found`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn get(
    State(state): State<AppState>,
    caller: Caller,
    ApiPath(id): ApiPath<KeyId>,
) -> Result<Json<KeyView>, ApiError> {
    caller.require_all_plants()?;
    let key = state.store.key(caller.organisation, id).await?.ok_or_else(|| no_key(id))?;
    Ok(Json(key.into()))
}

/// Revoke a key: from now on it opens nothing
#[utoipa::path(
    delete,
    path = "/api/v1/keys/{key}",
    tag = "access",
    security(("key" = ["admin"])),
    params(
        ("key" = Uuid, Path, description = "The key's identifier"),
        ("if-match" = Option<String>, Header, description = "Only as it was when it had one of these tags")
    ),
    responses(
        (status = 200, description = "Revoked, now or before", body = KeyView),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "`key_not_found`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn revoke(
    State(state): State<AppState>,
    caller: Caller,
    ApiPath(id): ApiPath<KeyId>,
    headers: HeaderMap,
) -> Result<Json<KeyView>, ApiError> {
    caller.require_all_plants()?;
    let seen = as_seen(&state, &caller, id, &headers).await?;
    let key = state.store.revoke_key(caller.organisation, id, seen.as_deref(), Timestamp::now()).await?;
    Ok(Json(key.ok_or_else(|| not_as_seen(seen.as_deref(), id))?.into()))
}

/// Give a key a new secret
///
/// The secret so far stays good for `grace_s` seconds, so that clients can change over.
#[utoipa::path(
    post,
    path = "/api/v1/keys/{key}/rotate",
    tag = "access",
    security(("key" = ["admin"])),
    params(
        ("key" = Uuid, Path, description = "The key's identifier"),
        ("if-match" = Option<String>, Header, description = "Only as it was when it had one of these tags")
    ),
    request_body = RotateKey,
    responses(
        (status = 200, description = "The key with its new secret", body = KeyWithSecret),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = "4XX", description = "`key_not_found`, `key_revoked`, `invalid_json`, `invalid_fields`, \
            `unsupported_media_type`, `too_large`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn rotate(
    State(state): State<AppState>,
    caller: Caller,
    ApiPath(id): ApiPath<KeyId>,
    headers: HeaderMap,
    ApiJson(asked): ApiJson<RotateKey>,
) -> Result<Json<KeyWithSecret>, ApiError> {
    caller.require_all_plants()?;
    let grace = SignedDuration::from_secs(i64::from(asked.grace_s));
    if grace > MAX_GRACE {
        return Err(ApiError::new(Code::InvalidFields, "grace_s is at most 2592000, 30 days"));
    }
    let seen = as_seen(&state, &caller, id, &headers).await?;
    let secret = new_secret()?;
    let until = Timestamp::now() + grace;
    let key = state.store.rotate_key(caller.organisation, id, seen.as_deref(), &secret.record(), until).await?;
    let Some(key) = key else {
        let there = state.store.key(caller.organisation, id).await?;
        return Err(match there.and_then(|key| key.revoked) {
            Some(revoked) if seen.is_none() => {
                let what = format!("key {id} was revoked at {revoked:.0}; make another with POST /api/v1/keys");
                ApiError::new(Code::KeyRevoked, what)
            }
            _ => not_as_seen(seen.as_deref(), id),
        });
    };
    Ok(Json(KeyWithSecret { secret: secret.reveal().to_owned(), key: key.into() }))
}

/// Something that was done, or refused.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct AuditView {
    #[schema(value_type = String, format = DateTime)]
    pub at: Timestamp,
    /// The key that it was done with; left out where it was done without one.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Uuid>)]
    pub key: Option<KeyId>,
    /// What that key is called.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "flight")]
    pub key_name: Option<String>,
    /// Whose token it was done with: the claim `sub` of the identity provider.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "pilot-7")]
    pub subject: Option<String>,
    #[schema(example = "DELETE")]
    pub method: String,
    #[schema(example = "/api/v1/plants")]
    pub path: String,
    /// The status of the answer.
    #[schema(example = 204)]
    pub status: u16,
    /// The request's `x-request-id`.
    #[schema(example = "01a1a0e5-6f2f-4a52-9f0e-8a3a9b1a6a10")]
    pub request_id: String,
}

impl From<AuditEntry> for AuditView {
    fn from(entry: AuditEntry) -> Self {
        let (key, key_name) = entry.key.unzip();
        Self {
            at: entry.at,
            key,
            key_name,
            subject: entry.subject,
            method: entry.method,
            path: entry.path,
            status: entry.status,
            request_id: entry.request_id,
        }
    }
}

/// The audit log, the newest first: every request of the organisation that changes something, and every one refused
#[utoipa::path(
    get,
    path = "/api/v1/audit",
    tag = "access",
    security(("key" = ["admin"])),
    params(AuditQuery),
    responses(
        (status = 200, body = List<AuditView>),
        (status = 400, description = "`invalid_query`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn audit(
    State(state): State<AppState>,
    caller: Caller,
    ApiQuery(query): ApiQuery<AuditQuery>,
) -> Result<List<AuditView>, ApiError> {
    caller.require_all_plants()?;
    let (part, within) = (query.part(), TimeSpan { since: query.since, until: query.until });
    let entries = state.store.audit(caller.organisation, within, part.page()?).await?;
    part.items(&query.path("/api/v1/audit"), entries, |(seq, _)| *seq, |(_, entry)| entry.into())
}
