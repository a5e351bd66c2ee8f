//! Webhooks: where the caller's organisation hears of the ends of its jobs, and what became of the messages.

use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::{ApiJson, ApiPath, ApiQuery};
use crate::http::middleware::access::Caller;
use crate::http::middleware::conditional;
use crate::http::middleware::idempotency::Once;
use crate::http::paging::{List, PageQuery, filtered_list, state_filter};
use crate::http::state::AppState;
use crate::store::webhooks::MAX_WEBHOOKS;
use crate::store::{Delivery, DeliveryId, DeliveryState, JobId, NewWebhook, SigningSecret, Webhook, WebhookId};
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use heliomap_model::PlantId;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

/// A webhook to be created.
#[derive(Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CreateWebhook {
    /// Where the messages go: `https://` and a public address, unless whoever runs the service lets them go elsewhere.
    #[schema(max_length = 2000, example = "https://dashboard.example.org/heliomap")]
    pub url: String,
    /// The plant whose jobs it is told of; all of the organisation's, those to come included, where it is left out.
    #[schema(value_type = Option<Uuid>)]
    pub plant: Option<PlantId>,
    /// What the messages are signed with; one is made where it is left out.
    #[schema(min_length = 16, max_length = 200, pattern = "^[!-~]+$")]
    pub secret: Option<String>,
}

/// A webhook, without its secret.
#[derive(Serialize, utoipa::ToSchema)]
pub struct WebhookView {
    #[schema(value_type = Uuid)]
    pub id: WebhookId,
    #[schema(example = "https://dashboard.example.org/heliomap")]
    pub url: String,
    /// The plant whose jobs it is told of; all where it is left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Uuid>)]
    pub plant: Option<PlantId>,
    #[schema(value_type = String, format = DateTime)]
    pub created: Timestamp,
}

impl From<Webhook> for WebhookView {
    fn from(webhook: Webhook) -> Self {
        Self { id: webhook.id, url: webhook.url, plant: webhook.plant, created: webhook.created }
    }
}

/// A webhook with its secret, which is shown this once.
#[derive(Serialize, utoipa::ToSchema)]
pub struct WebhookWithSecret {
    /// The key of the HMAC-SHA256 signatures in the header `heliomap-signature`.
    #[schema(example = "whsec-shown-this-once-only")]
    pub secret: String,
    #[serde(flatten)]
    pub webhook: WebhookView,
}

/// A message to a webhook: that a job has ended.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct DeliveryView {
    /// The `id` in the message.
    #[schema(value_type = Uuid)]
    pub id: DeliveryId,
    #[schema(value_type = Uuid)]
    pub job: JobId,
    /// `waiting`, `delivered`, or `dead` where it was tried as often as it is tried.
    #[schema(example = "delivered")]
    pub state: &'static str,
    /// How often it was tried.
    pub attempts: u32,
    /// When it is tried next.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    pub next_attempt: Option<Timestamp>,
    /// Why it did not arrive the last time.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "it answered 502")]
    pub error: Option<String>,
    #[schema(value_type = String, format = DateTime)]
    pub created: Timestamp,
    /// When it arrived or was given up.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    pub finished: Option<Timestamp>,
}

impl From<Delivery> for DeliveryView {
    fn from(delivery: Delivery) -> Self {
        Self {
            id: delivery.id,
            job: delivery.job,
            state: delivery.state.as_str(),
            attempts: delivery.attempts,
            next_attempt: (delivery.state == DeliveryState::Waiting).then_some(delivery.run_after),
            error: delivery.error,
            created: delivery.created,
            finished: delivery.finished,
        }
    }
}

filtered_list!(
    /// Which messages.
    DeliveriesQuery {
        /// Only those in this state: `waiting`, `delivered` or `dead`.
        #[param(pattern = "^(waiting|delivered|dead)$")]
        state: String,
    }
);

fn no_webhook(id: WebhookId) -> ApiError {
    ApiError::new(Code::WebhookNotFound, format!("no webhook has the identifier {id}; GET /api/v1/webhooks lists them"))
}

async fn require_webhook(state: &AppState, caller: &Caller, id: WebhookId) -> Result<Webhook, ApiError> {
    caller.require_all_plants()?;
    state.store.webhook(caller.organisation, id).await?.ok_or_else(|| no_webhook(id))
}

/// Create a webhook
///
/// From now on its URL is told of the end of every job of the plant, or of all plants, by `POST` with a JSON body. The header
/// `heliomap-signature` holds `t=`, the seconds since 1970, and `v1=`, the HMAC-SHA256 by the webhook's secret over these
/// seconds, a dot and the body, in hexadecimal digits. The secret is in the answer and nowhere else.
#[utoipa::path(
    post,
    path = "/api/v1/webhooks",
    tag = "webhooks",
    security(("key" = ["admin"])),
    request_body = CreateWebhook,
    responses(
        (status = 201, description = "Created", body = WebhookWithSecret, headers(("location" = String))),
        (status = "4XX", description = "`webhook_url`, `too_many_webhooks`, `plant_not_found`, `invalid_json`, \
            `invalid_fields`, `unsupported_media_type`, `too_large`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn create(
    State(state): State<AppState>,
    caller: Caller,
    ApiJson(asked): ApiJson<CreateWebhook>,
) -> Result<Response, ApiError> {
    caller.require_all_plants()?;
    let url = state.targets.check(&asked.url).map_err(|error| ApiError::new(Code::WebhookUrl, error.to_string()))?;
    if let Some(plant) = asked.plant {
        let found = state.store.plant(plant).await?;
        found.filter(|found| found.organisation == caller.organisation).ok_or_else(|| AppState::no_plant(plant))?;
    }
    let secret = match &asked.secret {
        Some(text) => SigningSecret::given(text).ok_or_else(|| {
            ApiError::new(
                Code::InvalidFields,
                "secret must be 16 to 200 visible ASCII characters; leave it out to have one made",
            )
        })?,
        None => SigningSecret::random().map_err(|error| ApiError::internal(&error))?,
    };
    let answer = secret.reveal().to_owned();
    let new = NewWebhook { organisation: caller.organisation, plant: asked.plant, url: url.into(), secret };
    let webhook = state.store.create_webhook(&new, Timestamp::now()).await?.ok_or_else(|| {
        let detail = format!("an organisation has {MAX_WEBHOOKS} webhooks at the most; delete one that is not needed");
        ApiError::new(Code::TooManyWebhooks, detail)
    })?;
    let location = format!("/api/v1/webhooks/{}", webhook.id);
    let answer = WebhookWithSecret { secret: answer, webhook: webhook.into() };
    Ok((StatusCode::CREATED, [(header::LOCATION, location)], Json(answer)).into_response())
}

/// List webhooks
#[utoipa::path(
    get,
    path = "/api/v1/webhooks",
    tag = "webhooks",
    security(("key" = ["admin"])),
    params(PageQuery),
    responses(
        (status = 200, body = List<WebhookView>),
        (status = 400, description = "`invalid_query`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn list(
    State(state): State<AppState>,
    caller: Caller,
    ApiQuery(query): ApiQuery<PageQuery>,
) -> Result<List<WebhookView>, ApiError> {
    caller.require_all_plants()?;
    let webhooks = state.store.webhooks(caller.organisation, query.page()?).await?;
    query.items("/api/v1/webhooks", webhooks, |webhook| webhook.seq, WebhookView::from)
}

/// One webhook
#[utoipa::path(
    get,
    path = "/api/v1/webhooks/{webhook}",
    tag = "webhooks",
    security(("key" = ["admin"])),
    params(("webhook" = Uuid, Path, description = "The webhook's identifier")),
    responses(
        (status = 200, body = WebhookView),
        (status = 404, description = "`webhook_not_found`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn get(
    State(state): State<AppState>,
    caller: Caller,
    ApiPath(id): ApiPath<WebhookId>,
) -> Result<Json<WebhookView>, ApiError> {
    Ok(Json(require_webhook(&state, &caller, id).await?.into()))
}

/// Delete a webhook with its messages
#[utoipa::path(
    delete,
    path = "/api/v1/webhooks/{webhook}",
    tag = "webhooks",
    security(("key" = ["admin"])),
    params(
        ("webhook" = Uuid, Path, description = "The webhook's identifier"),
        ("if-match" = Option<String>, Header, description = "Only as it was when it had one of these tags")
    ),
    responses(
        (status = 204, description = "It is told of nothing any more"),
        (status = 412, description = "`precondition_failed`", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "`webhook_not_found`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn delete(
    State(state): State<AppState>,
    caller: Caller,
    ApiPath(id): ApiPath<WebhookId>,
    headers: HeaderMap,
) -> Result<StatusCode, ApiError> {
    if conditional::is_asked(&headers) {
        conditional::require(&headers, &WebhookView::from(require_webhook(&state, &caller, id).await?))?;
    }
    caller.require_all_plants()?;
    match state.store.delete_webhook(caller.organisation, id).await? {
        true => Ok(StatusCode::NO_CONTENT),
        false => Err(no_webhook(id)),
    }
}

/// List the messages to a webhook, the newest first
///
/// With `state=dead` those that were given up. What arrived, or was given up, is forgotten after 30 days.
#[utoipa::path(
    get,
    path = "/api/v1/webhooks/{webhook}/deliveries",
    tag = "webhooks",
    security(("key" = ["admin"])),
    params(("webhook" = Uuid, Path, description = "The webhook's identifier"), DeliveriesQuery),
    responses(
        (status = 200, body = List<DeliveryView>),
        (status = "4XX", description = "`webhook_not_found`, `invalid_query`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn deliveries(
    State(state): State<AppState>,
    caller: Caller,
    ApiPath(id): ApiPath<WebhookId>,
    ApiQuery(query): ApiQuery<DeliveriesQuery>,
) -> Result<List<DeliveryView>, ApiError> {
    let part = query.part();
    let (page, wanted) =
        (part.page()?, state_filter::<DeliveryState>(query.state.as_deref(), "waiting, delivered and dead")?);
    let webhook = require_webhook(&state, &caller, id).await?;
    let found = state.store.deliveries(webhook.id, wanted, page).await?;
    let path = query.path(&format!("/api/v1/webhooks/{id}/deliveries"));
    part.items(&path, found, |delivery| delivery.seq, DeliveryView::from)
}

/// Send a message again
///
/// It is tried as often as a new one, whether it had arrived, was given up or waits.
#[utoipa::path(
    post,
    path = "/api/v1/webhooks/{webhook}/deliveries/{delivery}/resend",
    tag = "webhooks",
    security(("key" = ["admin"])),
    params(
        ("webhook" = Uuid, Path, description = "The webhook's identifier"),
        ("delivery" = Uuid, Path, description = "The message's identifier")
    ),
    responses(
        (status = 202, description = "It is sent in a moment", body = DeliveryView),
        (status = 404, description = "`webhook_not_found`, `delivery_not_found`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn resend(
    State(state): State<AppState>,
    caller: Caller,
    once: Option<Extension<Once>>,
    ApiPath((id, delivery)): ApiPath<(WebhookId, DeliveryId)>,
) -> Result<Response, ApiError> {
    let webhook = require_webhook(&state, &caller, id).await?;
    let once = once.map(|Extension(Once(id))| id);
    let found = state.store.resend_delivery(webhook.id, delivery, once, Timestamp::now()).await?.ok_or_else(|| {
        let detail = format!(
            "no message to this webhook has the identifier {delivery}; GET /api/v1/webhooks/{id}/deliveries lists them"
        );
        ApiError::new(Code::DeliveryNotFound, detail)
    })?;
    Ok((StatusCode::ACCEPTED, Json(DeliveryView::from(found))).into_response())
}
