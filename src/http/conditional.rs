//! What a client has already is not sent again: `ETag` and `If-None-Match` (RFC 9110) on everything that is read.

use crate::store::Digest;
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
    if *request.method() != Method::GET {
        return next.run(request).await;
    }
    let known = request.headers().get_all(header::IF_NONE_MATCH).iter().cloned().collect::<Vec<_>>();
    let response = next.run(request).await;
    if response.status() != StatusCode::OK {
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
