//! Requests that a client sends again because it did not hear the answer: under the same `Idempotency-Key` they are
//! answered the same, and done once.

use crate::http::error::{ApiError, Code};
use crate::http::middleware::access::Caller;
use crate::http::state::AppState;
use crate::store::requests::{Begun, KeptAnswer};
use crate::store::{Digest, OrganisationId};
use axum::body::{Body, BodyDataStream, to_bytes};
use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures::StreamExt;
use futures::stream::poll_fn;
use jiff::{SignedDuration, Timestamp};
use sha2::Digest as _;
use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::Poll;
use std::time::Duration;
use utoipa::openapi::path::{ParameterBuilder, ParameterIn};
use utoipa::openapi::schema::{ObjectBuilder, Type};
use utoipa::openapi::{ContentBuilder, OpenApi, Ref, Required, ResponseBuilder};
use uuid::Uuid;

const HEADER: &str = "idempotency-key";
/// Says that an answer is that of before.
const REPLAYED: HeaderName = HeaderName::from_static("idempotency-replayed");
/// Longest key, bytes.
const MAX_KEY: usize = 255;
/// How long an answer is kept.
pub const KEPT: SignedDuration = SignedDuration::from_hours(24);
/// How long a key is taken by a request that is not answered, because the service died over it say.
const TAKEN: SignedDuration = SignedDuration::from_mins(2);
/// Largest answer that is kept.
const MAX_ANSWER_BYTES: usize = 16 << 20;

/// What the first thing that a request under a key makes is identified by, so that the same request makes it once, though the
/// service dies before its answer is kept.
#[derive(Debug, Clone, Copy)]
pub struct Once(pub Uuid);

/// Whether the answers of an operation hold a secret, which is kept nowhere.
fn tells_secret(path: &str) -> bool {
    path.starts_with("/api/v1/keys") || path == "/api/v1/webhooks"
}

/// Whether requests to an operation may carry a key.
fn applies(method: &Method, path: &str) -> bool {
    matches!(*method, Method::POST | Method::PUT) && !tells_secret(path)
}

/// Answers a request that was answered before under its key as before.
pub async fn once(State(state): State<AppState>, path: MatchedPath, request: Request, next: Next) -> Response {
    let caller = request.extensions().get::<Caller>().map(|caller| caller.organisation);
    let (Some(organisation), Some(key)) = (caller, request.headers().get(HEADER)) else {
        return next.run(request).await;
    };
    if tells_secret(path.as_str()) {
        let what = "the answer holds a secret, which is kept nowhere: leave the idempotency-key out";
        return ApiError::new(Code::BadRequest, what).into_response();
    }
    if !applies(request.method(), path.as_str()) {
        return next.run(request).await;
    }
    let key = match read_key(key) {
        Ok(key) => key,
        Err(problem) => return problem.into_response(),
    };
    answer_once(&state, organisation, &key, request, next).await.unwrap_or_else(IntoResponse::into_response)
}

fn read_key(value: &HeaderValue) -> Result<String, ApiError> {
    let text = value.to_str().unwrap_or_default().trim();
    let text = text.strip_prefix('"').and_then(|text| text.strip_suffix('"')).unwrap_or(text);
    if text.is_empty() || text.len() > MAX_KEY {
        let what = format!("idempotency-key must be 1 to {MAX_KEY} visible ASCII characters, such as a UUID");
        return Err(ApiError::new(Code::BadRequest, what));
    }
    Ok(text.to_owned())
}

async fn answer_once(
    state: &AppState,
    organisation: OrganisationId,
    key: &str,
    request: Request,
    next: Next,
) -> Result<Response, ApiError> {
    let (now, token) = (Timestamp::now(), Uuid::new_v4());
    let begun = state.store.begin_request(organisation, key, token, now, now + TAKEN).await?;
    let (mut parts, body) = request.into_parts();
    let name = format!("{organisation} {} {key}", parts.uri.path());
    parts.extensions.insert(Once(Uuid::new_v5(&Uuid::NAMESPACE_URL, name.as_bytes())));
    let told = Told::new(&parts.method, &parts.uri.to_string(), &parts.headers, body);
    match begun {
        Begun::Running => {
            let what = "a request with this idempotency-key is being answered; send it again in a moment";
            Err(ApiError::new(Code::IdempotencyBusy, what).retry_after(2))
        }
        Begun::Answered(kept) => {
            if told.fingerprint(state.limits.request_timeout).await? != kept.fingerprint {
                let what = "another request was answered under this idempotency-key: give each request one of its own";
                return Err(ApiError::new(Code::IdempotencyKeyReused, what));
            }
            replay(*kept)
        }
        Begun::New => {
            // Whatever becomes of it, a request that is not answered well gives its key back.
            let taken = Taken { state: state.clone(), organisation, key: key.to_owned(), token, kept: false };
            let renewing = taken.renew();
            let response = tokio::select! {
                response = next.run(Request::from_parts(parts, told.body())) => response,
                never = renewing => match never {},
            };
            keep(taken, told, response).await
        }
    }
}

/// A key in the hands of a request; it is given back where no answer was kept, even if the client went away.
struct Taken {
    state: AppState,
    organisation: OrganisationId,
    key: String,
    token: Uuid,
    kept: bool,
}

impl Taken {
    /// Keeps the key for as long as it is polled: a large upload takes its time.
    async fn renew(&self) -> Infallible {
        loop {
            tokio::time::sleep(TAKEN.unsigned_abs() / 4).await;
            let until = Timestamp::now() + TAKEN;
            if let Err(error) = self.state.store.renew_request(self.organisation, &self.key, self.token, until).await {
                tracing::warn!(%error, "an idempotency key cannot be kept");
            }
        }
    }
}

impl Drop for Taken {
    fn drop(&mut self) {
        if !self.kept {
            let (state, organisation, token) = (self.state.clone(), self.organisation, self.token);
            let key = std::mem::take(&mut self.key);
            tokio::spawn(async move {
                if let Err(error) = state.store.forget_request(organisation, &key, token).await {
                    tracing::warn!(%error, "an idempotency key cannot be given back");
                }
            });
        }
    }
}

/// Keeps an answer that tells of success; after any other the request may be sent again once what was wrong is mended.
async fn keep(mut taken: Taken, told: Told, response: Response) -> Result<Response, ApiError> {
    if !response.status().is_success() {
        return Ok(response);
    }
    let (parts, body) = response.into_parts();
    let body = to_bytes(body, MAX_ANSWER_BYTES).await.map_err(|_| {
        ApiError::new(Code::TooLarge, "it is done, but its answer is too large to be kept: ask for it with GET")
    })?;
    let headers = parts.headers.iter().filter_map(|(name, value)| Some((name.to_string(), value.to_str().ok()?)));
    let headers: serde_json::Map<String, serde_json::Value> =
        headers.map(|(name, value)| (name, value.into())).collect();
    let kept = KeptAnswer {
        fingerprint: told.fingerprint(taken.state.limits.request_timeout).await?,
        status: parts.status.as_u16(),
        headers: serde_json::Value::Object(headers).to_string(),
        body: body.to_vec(),
    };
    let until = Timestamp::now() + KEPT;
    taken.state.store.keep_answer(taken.organisation, &taken.key, taken.token, &kept, until).await?;
    taken.kept = true;
    Ok(Response::from_parts(parts, Body::from(body)))
}

fn replay(kept: KeptAnswer) -> Result<Response, ApiError> {
    let status = StatusCode::from_u16(kept.status).map_err(|error| ApiError::internal(&error))?;
    let headers: std::collections::BTreeMap<String, String> =
        serde_json::from_str(&kept.headers).map_err(|error| ApiError::internal(&error))?;
    let mut response = (status, kept.body).into_response();
    response.headers_mut().remove(header::CONTENT_TYPE);
    for (name, value) in headers {
        if let (Ok(name), Ok(value)) = (HeaderName::try_from(name), HeaderValue::try_from(value)) {
            response.headers_mut().insert(name, value);
        }
    }
    response.headers_mut().insert(REPLAYED, HeaderValue::from_static("true"));
    Ok(response)
}

/// What a request says: its body passes through and is digested on its way.
#[derive(Clone)]
struct Told(Arc<Mutex<Passing>>);

struct Passing {
    rest: BodyDataStream,
    digest: sha2::Sha256,
    /// What parts a form, which clients make up anew each time; empty for any other body.
    boundary: Vec<u8>,
    /// What came last and may be the beginning of a boundary.
    tail: Vec<u8>,
    finished: bool,
}

impl Told {
    fn new(method: &Method, uri: &str, headers: &HeaderMap, body: Body) -> Self {
        let kind = headers.get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok()).unwrap_or_default();
        let (essence, parameters) = kind.split_once(';').unwrap_or((kind, ""));
        let boundary = parameters.split(';').find_map(|parameter| parameter.trim().strip_prefix("boundary="));
        let boundary = boundary.map(|boundary| boundary.trim_matches('"').as_bytes().to_vec()).unwrap_or_default();
        let mut digest = sha2::Sha256::new();
        // What tus tells of a file stands in its headers.
        let told = ["upload-length", "upload-metadata", "upload-concat"].map(|name| headers.get(name));
        let told = told.map(|value| value.map(HeaderValue::as_bytes).unwrap_or_default());
        for part in [method.as_str().as_bytes(), uri.as_bytes(), essence.trim().as_bytes()].iter().chain(&told) {
            digest.update((part.len() as u64).to_le_bytes());
            digest.update(part);
        }
        let rest = body.into_data_stream();
        Self(Arc::new(Mutex::new(Passing { rest, digest, boundary, tail: Vec::new(), finished: false })))
    }

    fn passing(&self) -> std::sync::MutexGuard<'_, Passing> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The body, for whoever answers the request.
    fn body(&self) -> Body {
        let told = self.clone();
        Body::from_stream(poll_fn(move |context| {
            let mut passing = told.passing();
            let polled = passing.rest.poll_next_unpin(context);
            match &polled {
                Poll::Ready(Some(Ok(chunk))) => passing.digest(chunk),
                Poll::Ready(None) => passing.finished = true,
                _ => {}
            }
            polled
        }))
    }

    /// The digest of the whole request, once all of it has come.
    async fn fingerprint(&self, idle: Duration) -> Result<Digest, ApiError> {
        let mut body = self.body().into_data_stream();
        while !self.passing().finished {
            match tokio::time::timeout(idle, body.next()).await {
                Ok(None) => break,
                Ok(Some(Ok(_))) => {}
                Ok(Some(Err(_))) => {
                    return Err(ApiError::new(Code::UploadInterrupted, "the request ended early; send it again"));
                }
                Err(_) => return Err(ApiError::new(Code::UploadStalled, "the request stood still; send it again")),
            }
        }
        let mut passing = self.passing();
        let tail = std::mem::take(&mut passing.tail);
        passing.digest.update(&tail);
        Ok(Digest(passing.digest.clone().finalize().into()))
    }
}

impl Passing {
    fn digest(&mut self, chunk: &[u8]) {
        if self.boundary.is_empty() {
            self.digest.update(chunk);
            return;
        }
        self.tail.extend_from_slice(chunk);
        let length = self.boundary.len();
        let mut from = 0;
        while let Some(at) = self.tail[from..].windows(length).position(|window| window == self.boundary) {
            self.digest.update(&self.tail[from..from + at]);
            from += at + length;
        }
        let keep = (self.tail.len() - from).min(length - 1);
        let to = self.tail.len() - keep;
        self.digest.update(&self.tail[from..to]);
        self.tail.drain(..to);
    }
}

/// Adds the key to the description of every operation that takes one.
pub fn describe(description: &mut OpenApi) {
    let text = "The same request under the same key within 24 hours is done once and answered the same, with \
                `idempotency-replayed: true`; only answers of success are kept";
    let parameter = ParameterBuilder::new()
        .name(HEADER)
        .parameter_in(ParameterIn::Header)
        .required(Required::False)
        .description(Some(text))
        .schema(Some(
            ObjectBuilder::new()
                .schema_type(Type::String)
                .min_length(Some(1))
                .max_length(Some(MAX_KEY))
                .pattern(Some("^[!-~]+$"))
                .examples(["0c5a2f6e-3f0e-4d39-9f0c-6a0c1f2b7d11"]),
        ))
        .build();
    let problem = |text: &str| {
        let content = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem"))).build();
        ResponseBuilder::new().description(text).content("application/problem+json", content).build()
    };
    for (path, item) in &mut description.paths.paths {
        for (method, operation) in [(Method::POST, &mut item.post), (Method::PUT, &mut item.put)] {
            let Some(operation) = operation.as_mut().filter(|_| applies(&method, path)) else { continue };
            operation.parameters.get_or_insert_default().push(parameter.clone().into());
            let responses = &mut operation.responses.responses;
            responses.entry("400".to_owned()).or_insert_with(|| {
                problem("`bad_request`: the idempotency key is none; or another reason, as the code tells").into()
            });
            responses.entry("409".to_owned()).or_insert_with(|| {
                problem("`idempotency_busy`: the request is being answered; or another conflict, as the code tells")
                    .into()
            });
            responses.entry("422".to_owned()).or_insert_with(|| {
                problem("`idempotency_key_reused`; or what is wrong with the request, as the code tells").into()
            });
        }
    }
}
