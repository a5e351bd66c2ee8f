//! What a client has already is not sent again: `ETag` and `If-None-Match` (RFC 9110) on everything that is read. And nobody
//! changes what someone else changed meanwhile, unless that is wanted: `If-Match` on what is replaced or deleted.

use crate::http::error::{ApiError, Code};
use crate::store::{Digest, Wanted};
use axum::body::{Body, HttpBody, to_bytes};
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use utoipa::openapi::header::HeaderBuilder;
use utoipa::openapi::path::{ParameterBuilder, ParameterIn};
use utoipa::openapi::schema::{ObjectBuilder, Type};
use utoipa::openapi::{OpenApi, RefOr, Required, ResponseBuilder};

/// Largest answer whose tag is made from its bytes.
const MAX_BYTES: u64 = 8 << 20;

/// A tag for what these bytes stand for. Weak, because the same answer may be sent compressed.
pub fn tag(of: &[u8]) -> String {
    format!("W/\"{}\"", &Digest::of(of).to_string()[..32])
}

/// Tags what was read, and answers `304` where the client has it. An answer that has a tag already keeps it; one whose end
/// is not known gets none.
pub async fn conditional(request: Request, next: Next) -> Response {
    if !matches!(*request.method(), Method::GET | Method::HEAD) {
        return next.run(request).await;
    }
    let known = request.headers().get_all(header::IF_NONE_MATCH).iter().cloned().collect::<Vec<_>>();
    let response = next.run(request).await;
    // What nobody may keep changes from one request to the next.
    let kept = response.headers().get(header::CACHE_CONTROL).is_none_or(|control| control != "no-store");
    if response.status() != StatusCode::OK || !kept {
        return response;
    }
    let (mut parts, body) = response.into_parts();
    let (tag, body) = match (parts.headers.get(header::ETAG), body.size_hint().exact()) {
        (Some(tag), _) => (tag.to_str().unwrap_or_default().to_owned(), body),
        (None, Some(0..=MAX_BYTES)) => match to_bytes(body, MAX_BYTES as usize).await {
            Ok(bytes) => (tag(&bytes), Body::from(bytes)),
            Err(_) => return StatusCode::INTERNAL_SERVER_ERROR.into_response(),
        },
        (None, _) => return Response::from_parts(parts, body),
    };
    if let Ok(value) = HeaderValue::from_str(&tag) {
        parts.headers.insert(header::ETAG, value);
    }
    if !known.iter().any(|value| matches(value, &tag)) {
        return Response::from_parts(parts, body);
    }
    let kept = [header::ETAG, header::CACHE_CONTROL, header::LINK];
    let headers: HeaderMap =
        kept.into_iter().filter_map(|name| Some((name.clone(), parts.headers.get(name)?.clone()))).collect();
    (StatusCode::NOT_MODIFIED, headers).into_response()
}

/// The tag of a file, by which it may be replaced.
pub fn file_tag(sha256: Digest) -> String {
    format!("\"{sha256}\"")
}

/// What a request wants to be at a file's place: one of the files of `If-Match`, or none of those of `If-None-Match`.
pub fn wanted(headers: &HeaderMap) -> Option<Wanted> {
    let (only, but) = (tags(headers, header::IF_MATCH), tags(headers, header::IF_NONE_MATCH));
    // What is no tag of a file is that of none.
    let digests = |tags: Vec<String>| {
        tags.iter().filter_map(|tag| tag.trim_start_matches("W/").trim_matches('"').parse().ok()).collect()
    };
    let all = |tags: &[String]| tags.iter().any(|tag| tag == "*");
    match (only, but) {
        (Some(tags), _) if all(&tags) => Some(Wanted::Anything),
        (Some(tags), _) => Some(Wanted::OneOf(digests(tags))),
        (None, Some(tags)) if all(&tags) => Some(Wanted::Nothing),
        (None, Some(tags)) => Some(Wanted::NoneOf(digests(tags))),
        (None, None) => None,
    }
}

/// The tags that a header lists; `None` where there is no such header.
fn tags(headers: &HeaderMap, name: header::HeaderName) -> Option<Vec<String>> {
    let mut values = headers.get_all(name).iter().peekable();
    values.peek()?;
    let texts = values.filter_map(|value| value.to_str().ok());
    Some(texts.flat_map(|text| text.split(',')).map(|tag| tag.trim().to_owned()).collect())
}

/// Refuses a request that is about a state of what has none: `what` it brings.
pub fn refuse(headers: &HeaderMap, what: &str) -> Result<(), ApiError> {
    match [header::IF_MATCH, header::IF_NONE_MATCH].iter().find(|name| headers.contains_key(*name)) {
        None => Ok(()),
        Some(name) => {
            let detail = format!(
                "{name} speaks of one file, and this request brings {what}; nothing of it was done: send the files one by one"
            );
            Err(ApiError::new(Code::BadRequest, detail))
        }
    }
}

/// What is said where something is not as the request wants it.
pub fn failed() -> ApiError {
    ApiError::new(
        Code::PreconditionFailed,
        "someone changed it meanwhile, and nothing of this request was done: look at it as it is now, then decide anew",
    )
}

/// Whether a request says which state of something it is about.
pub fn is_asked(headers: &HeaderMap) -> bool {
    headers.contains_key(header::IF_MATCH)
}

/// Refuses a request that is about another state of something than this, which `GET` would answer.
pub fn require(headers: &HeaderMap, current: &impl serde::Serialize) -> Result<(), ApiError> {
    let current = tag(&serde_json::to_vec(current).map_err(|error| ApiError::internal(&error))?);
    let holds = headers.get_all(header::IF_MATCH).iter().any(|value| matches(value, &current));
    if holds || !is_asked(headers) { Ok(()) } else { Err(failed()) }
}

/// Whether a list of tags holds one, by the weak comparison.
fn matches(list: &HeaderValue, tag: &str) -> bool {
    let strong = |tag: &str| tag.trim().trim_start_matches("W/").to_owned();
    list.to_str().is_ok_and(|list| list.split(',').any(|one| one.trim() == "*" || strong(one) == strong(tag)))
}

/// Adds tags to the description of every operation that reads.
pub fn describe(description: &mut OpenApi) {
    let text = || ObjectBuilder::new().schema_type(Type::String).build();
    let parameter = ParameterBuilder::new()
        .name("if-none-match")
        .parameter_in(ParameterIn::Header)
        .required(Required::False)
        .description(Some("Tags of answers that the client has: where one still holds, the answer is 304"))
        .schema(Some(text()))
        .build();
    for operation in description.paths.paths.values_mut().filter_map(|item| item.get.as_mut()) {
        let Some(RefOr::T(found)) = operation.responses.responses.get_mut("200") else { continue };
        if found.content.contains_key("text/event-stream") {
            continue;
        }
        found.headers.insert("etag".to_owned(), HeaderBuilder::new().schema(Some(text())).build().into());
        operation.parameters.get_or_insert_default().push(parameter.clone().into());
        let unchanged = ResponseBuilder::new().description("What the client has still holds").build();
        operation.responses.responses.insert("304".to_owned(), unchanged.into());
    }
}
